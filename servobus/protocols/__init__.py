"""FLOOR 1: the languages of the wire, sans-IO."""
