"""The command line: one small module per command, and nothing of the mechanics."""
