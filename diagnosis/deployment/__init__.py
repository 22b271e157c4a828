"""The deployment doctor: whether code, actuator or task makes a policy fail on the machine."""
