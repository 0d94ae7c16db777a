"""trms: a command-line laboratory for the twin rotor MIMO system."""

__version__ = "0.1.0"
