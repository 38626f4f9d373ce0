"""Known worlds: furnished rooms in which people move, with their truth and with noise."""
