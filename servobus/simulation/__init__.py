"""Simulated lines whose bytes take their time on the wire, PTYs for other programs, and a simulated arm on TCP."""
