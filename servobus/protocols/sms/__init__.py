"""FEETECH SMS 1.0 and its relatives (STS, SCS): the seed's instruction packets on RS485 or TTL."""
