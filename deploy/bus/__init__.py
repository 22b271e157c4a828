"""The bus: its description (a DBC), protection against faults on the way, and the wires that python-can knows."""
