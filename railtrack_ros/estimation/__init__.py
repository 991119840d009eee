"""From axle-box acceleration to contact force, rail deflection and irregularity, as a stream."""
