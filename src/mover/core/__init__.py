"""What all share: records, nouns, errors, the resumable run."""
