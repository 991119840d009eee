"""How the track moves: forward solvers in time, and the track in the frequency domain."""
