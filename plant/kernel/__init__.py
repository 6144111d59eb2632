"""What every compiled function builds on: compilation, array layout, packing of parameters."""
