"""Why each object stands where it stands, and how well that is known."""
