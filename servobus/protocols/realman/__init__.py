"""The language of RealMan arms, which pass Modbus-RTU on to their RS485 ports (RealMan JSON). A link and a simulator speak it."""
