"""Ways to plug a firmware in: a Python class, C source, a WebAssembly module."""
