"""J1939 in a log: gear shifts of any truck."""
