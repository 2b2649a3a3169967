"""Real tosses of a cube: how far dano's rollouts end up from what was measured, next to MuJoCo's."""
