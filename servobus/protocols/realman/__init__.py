"""The JSON lines by which a RealMan arm passes Modbus on to its RS485 ports: a language, for a link and a simulator."""
