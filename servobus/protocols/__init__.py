"""The protocols of the wire. Nothing here does I/O or knows the time."""
