"""How closely dano reproduces stored rollouts, large-step differences and closed-form mass properties."""
