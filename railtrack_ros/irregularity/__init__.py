"""Vertical irregularity of rail and wheel: profiles, the ISO 3095 spectrum, roughness levels."""
