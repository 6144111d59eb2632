"""Physical parts as compiled functions: chamber, flow, friction, oil damper, synchronizer."""
