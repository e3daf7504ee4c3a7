"""python -m servobus."""

from servobus.doors.cli import main

main()
