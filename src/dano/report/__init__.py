"""Pictures for people: videos of trajectories, figures of objects, an interactive viewer."""

from dano.report._comparison import (
    draw_rest as draw_rest,
    verdict as verdict,
    write_comparison_report as write_comparison_report,
)
from dano.report._identification import (
    draw_simulated as draw_simulated,
    write_film_report as write_film_report,
    write_identification_report as write_identification_report,
)
from dano.report._object import draw_object as draw_object
from dano.report._page import Pictures as Pictures, write_grades as write_grades
from dano.report._plan import (
    draw_controls as draw_controls,
    film_plan as film_plan,
    PLAN_VIDEO as PLAN_VIDEO,
)
from dano.report._stage import CAMERAS as CAMERAS, frame_count as frame_count
from dano.report._tracking import (
    draw_tracked as draw_tracked,
    write_tracking_report as write_tracking_report,
)
from dano.report._training import (
    draw_capture as draw_capture,
    mass_estimates as mass_estimates,
    MassEstimates as MassEstimates,
    write_training_report as write_training_report,
)
from dano.report._video import (
    checked_size as checked_size,
    film_run as film_run,
    render_side_by_side as render_side_by_side,
    render_start as render_start,
    render_trajectory as render_trajectory,
    VideoOptions as VideoOptions,
)
from dano.report.viewing import (
    LiveView as LiveView,
    show_run as show_run,
    view as view,
    view_capture as view_capture,
    view_field as view_field,
    view_splats as view_splats,
    Viewer as Viewer,
    write_capture_view as write_capture_view,
    write_field_view as write_field_view,
    write_view as write_view,
)
