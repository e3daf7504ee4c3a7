"""FLOOR 3: what the native door and its clients say to each other: JSON-RPC 2.0, one object a line."""
