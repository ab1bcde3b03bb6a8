"""Single-task learners: policy gradients and Q-learning."""
