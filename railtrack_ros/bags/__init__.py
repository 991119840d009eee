"""Recordings in and out, and the one codec between messages and arrays."""
