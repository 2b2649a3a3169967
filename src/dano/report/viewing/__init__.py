"""Runs, fields and captures in the browser: a page on this computer, or one file to send to others."""

from dano.report.viewing._capture import (
    view_capture as view_capture,
    write_capture_view as write_capture_view,
)
from dano.report.viewing._field import view_field as view_field, write_field_view as write_field_view
from dano.report.viewing._serving import Viewer as Viewer
from dano.report.viewing._splats import view_splats as view_splats
from dano.report.viewing._viewer import (
    LiveView as LiveView,
    show_run as show_run,
    view as view,
    write_view as write_view,
)
