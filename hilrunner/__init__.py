"""hilrunner: a hardware-in-the-loop bench in software for hydraulic crane actuators."""

__version__ = "0.1.0"
