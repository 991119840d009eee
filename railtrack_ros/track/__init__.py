"""The track: its description, the rail element, supports, assembly, the infinite track."""
