"""What a step of a robot costs beside MuJoCo and frax, and how its free swing keeps its energy."""
