"""Modbus-RTU: a language, not a device. Protocols whose devices speak it build on these frames and requests."""
