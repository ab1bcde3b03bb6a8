"""What turns experiments into evidence: stored runs, statistics, figures, claims, the book."""
