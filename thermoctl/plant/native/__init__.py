"""Machine code that plants call: the C compiler and its cache, and the binaries of FMUs."""
