"""The messages between a daemon and its clients: JSON-RPC 2.0, one object a line (docs/native-door.md)."""
