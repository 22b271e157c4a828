"""Measurements by heading of the results page."""

from rooms import actuators, deploy, diagnosis, perception, simulator, training

ROOMS = {
    "Policies": training.MEASUREMENTS,
    "Speed": simulator.MEASUREMENTS,
    "Actuator models": actuators.MEASUREMENTS,
    "Diagnosis": diagnosis.MEASUREMENTS,
    "Perception": perception.MEASUREMENTS,
    "On the machine": deploy.MEASUREMENTS,
}
