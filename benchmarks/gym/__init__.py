"""Environments: how long their steps take, and Gymnasium's models beside MuJoCo."""
