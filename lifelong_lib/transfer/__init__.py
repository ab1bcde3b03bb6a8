"""What carries knowledge from task to task."""
