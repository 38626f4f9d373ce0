"""The capture folder of docs/conventions.md, and how captures are built and merged."""
