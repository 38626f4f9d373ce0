"""Data that ships with the package, and the scripts that build it."""
