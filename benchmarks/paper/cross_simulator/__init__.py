"""Friction and mass of bodies that MuJoCo pushes and slides, identified with dano."""
