"""Pictures for people: videos of trajectories, figures of objects, an interactive viewer."""

from dano.report._object import draw_object as draw_object
from dano.report._stage import contact_history as contact_history, ContactHistory as ContactHistory
from dano.report._video import render_trajectory as render_trajectory
from dano.report._viewer import view as view, Viewer as Viewer
