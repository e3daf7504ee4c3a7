"""servobus: one asyncio service that owns a robot's serial lines. These are the public names, and nothing else."""
