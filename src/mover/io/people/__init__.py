"""People from today's tools: a tool is a file here and a row in `mover.io.formats`."""
