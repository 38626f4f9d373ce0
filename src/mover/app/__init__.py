"""What a user meets: commands, report, viewer, pictures, batches."""
