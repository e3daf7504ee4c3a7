"""python -m servobus."""

from servobus.cli import main

main()
