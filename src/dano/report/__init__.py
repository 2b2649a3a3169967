"""Pictures for people: videos of trajectories, figures of objects, an interactive viewer."""

from dano.report._video import render_trajectory as render_trajectory
