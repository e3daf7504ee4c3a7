"""Modbus-RTU: a language that drivers and tunnels use, not a protocol of its own."""
