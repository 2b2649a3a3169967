"""Runs in the browser: a page that plays them, with sliders, or one file to send to others."""

from dano.report.viewing._viewer import view as view, Viewer as Viewer, write_view as write_view
