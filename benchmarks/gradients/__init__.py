"""What derivatives through impacts are worth: `python -m benchmarks.gradients`."""
