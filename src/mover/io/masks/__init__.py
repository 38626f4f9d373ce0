"""Instance masks and boxes that other tools wrote."""
