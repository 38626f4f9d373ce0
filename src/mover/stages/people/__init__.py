"""The people: which frames count, how deep they stand, refined in the room."""
