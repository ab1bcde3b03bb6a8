"""What is learned on: simulated systems, robots, intersections and data sets."""
