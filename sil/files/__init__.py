"""Files: settings from the command line, output folders."""
