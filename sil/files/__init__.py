"""Files: typed TOML, settings from the command line, output folders."""
