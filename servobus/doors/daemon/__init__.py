"""FLOOR 5: what makes a rig with a door a service of the system: readiness, watchdog, reload, unit files."""
