"""The daemon: one rig for many programs, by JSON-RPC 2.0, one object a line (docs/native-door.md)."""
