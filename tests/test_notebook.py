"""What notebooks show of values."""

import subprocess
import sys
import xml.etree.ElementTree as ET

import jax
import numpy as np

import dano
from dano.notebook import card, cloud, curves


def test_values_show_their_numbers_and_a_drawing():
    field = dano.Box((0.05, 0.03, 0.02))
    bar = dano.NeuralObject.from_field(field, mass=0.3, n_samples=200, resolution=24, key=jax.random.key(0))
    shown = bar._repr_html_()
    ET.fromstring(shown)  # well formed
    assert '<td style="text-align:left">0.3</td>' in shown and shown.count("<circle") > 50
    scene = dano.Scene.create(
        [dano.Body("<ball>", dano.Sphere(0.05), mass=2.0), dano.Body("floor", dano.HalfSpace(), fixed=True)],
        [dano.Contact("<ball>", "floor")],
    )
    shown = scene._repr_html_()
    ET.fromstring(shown)
    assert "&lt;ball&gt; – floor" in shown and "2 kg" in shown and "<circle" in shown
    run = dano.simulate(scene, scene.initial_state(), n_steps=3)
    shown = run._repr_html_()
    ET.fromstring(shown)
    assert "<polyline" in shown and "3, 0.03 s" in shown


def test_drawings():
    normals = np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
    # What faces away from the viewer is not drawn.
    assert cloud(normals * 0.1, normals).count("<circle") == 1
    line = ET.fromstring(curves(np.arange(3.0), {"a": np.array([0.0, 1.0, np.nan])}, "height")).find(
        "polyline"
    )
    assert line is not None and len(line.attrib["points"].split()) == 2
    assert "&amp;" in card("a & b", [])


def test_nothing_that_draws_is_imported():
    program = "import dano, sys; print([m for m in ('matplotlib', 'PIL', 'IPython') if m in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"
