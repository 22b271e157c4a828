"""The CAN bus: description, end-to-end protection, and access through python-can."""
