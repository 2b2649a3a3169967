"""Every example runs, and its numbers obey physics."""

import runpy
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run(name: str) -> dict:
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](quick=True)


def test_every_example_is_tested():
    tested = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert {path.stem[3:] for path in EXAMPLES.glob("*.py")} <= tested


def test_drop():
    answer = run("01_drop")
    assert answer["unconverged_steps"] == 0
    # At rest the floor carries the weight; on the way there it stopped the fall.
    assert answer["carried_weight"] == pytest.approx(1, abs=0.02)
    assert answer["largest_force"] > 3 * 9.81
    assert answer["speed"] < 0.01
    assert 0.02 < answer["height"] < 0.08


def test_gradient_of_a_slide():
    answer = run("02_gradient_of_a_slide")
    assert answer["forward"] == pytest.approx(answer["reverse"], rel=1e-8)
    assert answer["reverse"] == pytest.approx(answer["difference"], rel=0.1)
    # Coulomb's point mass does not rock on its feet.
    assert answer["distance"] == pytest.approx(answer["coulomb_distance"], rel=0.1)
    assert answer["reverse"] == pytest.approx(answer["coulomb_slope"], rel=0.3)


def test_two_bunnies():
    answer = run("03_two_bunnies")
    assert answer["unconverged_steps"] == 0
    assert answer["steps_in_contact"] > 5
    # The limit of small steps; between two bodies that move impulses act from the start of a step, 2 ms here.
    assert answer["exchanged_momentum"] == pytest.approx(0.777, rel=0.05)
    assert answer["linear_drift"] < 1e-10
    assert answer["angular_drift"] < 1e-10


def test_own_field():
    answer = run("04_own_field")
    assert answer["unconverged_steps"] == 0
    assert answer["bake_error_rms"] < 0.05
    assert abs(answer["bake_error_mass"]) < 0.01
    assert answer["inertia_error"] < 0.005
    assert answer["com_offset"] < 1e-5
    assert answer["height_at_rest"] == pytest.approx(0.02, abs=0.002)


def test_batch_of_rollouts():
    answer = run("05_batch_of_rollouts")
    assert answer["converged"]
    distances = np.array(answer["distances"])
    assert np.all(np.diff(distances) < 0)
    np.testing.assert_allclose(distances, 0.5**2 / (2 * np.array(answer["frictions"]) * 9.81), rtol=0.1)


def test_linearize_and_control():
    answer = run("06_linearize_and_control")
    assert answer["unconverged_steps"] == 0
    assert answer["largest_eigenvalue"] < 1
    assert answer["largest_offset"] > 0.01
    assert answer["final_offset"] < 1e-3
    assert answer["final_spin"] < 0.01


def test_door():
    answer = run("07_door")
    assert answer["unconverged_steps"] == 0
    # Half of the approaching speed is left; the rest of the ball's speed comes from the door.
    assert answer["ball_after"] > 0.2
    assert 0 < answer["door_after"] < answer["door_before"]
    # The bodies meet as deep as an impact, .15 mm, on arms of some 5 cm.
    assert answer["momentum_drift"] < 4e-3
    assert 0.5 < answer["energy_left"] < 1


def test_mujoco_kick():
    pytest.importorskip("mujoco")
    answer = run("08_mujoco_kick")
    # It flies off and lies on the floor again.
    assert answer["fastest"] > 0.5
    assert answer["way"] > 0.03
    assert 0.02 < answer["height"] < 0.08


def test_mujoco_push():
    pytest.importorskip("mujoco")
    answer = run("09_mujoco_push")
    assert answer["pushed"] > 0.03
    assert answer["hand_contacts"] > 0
    assert answer["joint_error"] < 0.1


def test_mujoco_panda():
    pytest.importorskip("mujoco")
    if find_spec("frax") is None:
        pytest.skip("the package frax, which ships the Panda, is not installed: pip install frax")
    answer = run("10_mujoco_panda")
    # The hand goes 20 cm, the first 7 of them before it meets the bunny, and pushes it straight ahead.
    assert answer["pushed"] == pytest.approx(0.13, abs=0.03)
    assert abs(answer["aside"]) < 0.02
    assert answer["hand_contacts"] > 3
    assert answer["joint_error"] < 0.02


@pytest.mark.skipif(find_spec("mujoco_warp") is None, reason="worlds of MuJoCo Warp need mujoco-warp")
def test_mujoco_worlds():
    answer = run("11_mujoco_worlds")
    # As Coulomb says of a point, which does not rock.
    expected = 0.3**2 / (2 * 9.81 * answer["friction"])
    assert answer["way"] == pytest.approx(expected, rel=0.15)


@pytest.mark.skipif(find_spec("pybullet_data") is None, reason="the package pybullet ships the Panda")
def test_mujoco_grip():
    pytest.importorskip("mujoco")
    answer = run("12_mujoco_grip")
    # Way of the arm, less what the mug's weight bends it; a mug that turns in the fingers would slip on them.
    assert answer["lifted"] == pytest.approx(0.1, abs=0.004)
    assert answer["slip"] < 0.002
    assert answer["upright"] > np.cos(np.radians(3))
