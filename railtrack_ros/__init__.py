"""Contact force, rail deflection and rail irregularity from axle-box acceleration."""

__version__ = '0.1.0'
