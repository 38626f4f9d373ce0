"""Look at a room in the browser, correct it, and solve it again (extra `viewer`)."""
