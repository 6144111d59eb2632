"""Plant and firmware as FMI 3.0 co-simulation units for other tools."""
