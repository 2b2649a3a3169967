"""What a step, a gradient and a query of dano cost, next to MuJoCo's C engine in the same process."""
