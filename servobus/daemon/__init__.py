"""FLOOR 5: the native door: a rig for any number of programs, by JSON-RPC 2.0, one object a line (`docs/native-door.md`)."""
