"""The place of the phone films: a table with newspaper, patches in the object's colours, things, a hand."""

import numpy as np
import trimesh
from render_images import srgb
from render_table import TAG_ID

SIDE, TEXELS = 1.5, 4096  # of the table [m], texels along it
TAG_TEXELS = 210
TAG_SIDE = TAG_TEXELS * SIDE / TEXELS  # of the printed tag's black square [m], 76.9 mm
TAG = (0.02, 0.24)  # where its middle is, nearly [m]
PAPER = 0.34, 0.44  # sides of a sheet of newspaper [m]
BEIGE, INK, SHEET = (0.62, 0.54, 0.44), (40, 40, 43), (214, 211, 200)  # sRGB
WORDS = "the of market water seven yesterday council bridge where open light winter a in paper price".split()


def tabletop(seed: int, own: np.ndarray, *, papers: int, patches: int) -> np.ndarray:
    """Colours of the table from above, as sRGB, first row furthest along y.

    Args:
        seed: Of what lies where.
        own: Colours of the object, linear, shape (n, 3): half of the patches have them.
        papers: Sheets of newspaper.
        patches: Coloured patches.
    """
    import cv2

    rng = np.random.default_rng(seed)
    colours = np.full((TEXELS, TEXELS, 3), BEIGE)
    for cells, strength in ((14, 0.04), (60, 0.05), (200, 0.05), (700, 0.04)):
        noise = rng.normal(size=(cells, cells, 1)) + 0.3 * rng.normal(size=(cells, cells, 3))
        colours += strength * cv2.resize(noise, (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC)
    for k in range(papers):
        middle = np.array([(-0.17, 0.10), (0.20, 0.02), (0.02, -0.30), (-0.42, 0.25)][k % 4])
        _lay(colours, _newspaper(rng), middle + rng.normal(0, 0.02, 2), rng.normal(0.15, 0.35))
    for k in range(patches):
        bright = rng.uniform(0.08, 0.9, 3)
        colour = srgb(own[rng.integers(len(own))]) if k % 2 == 0 else bright
        shape = np.full((*rng.integers(70, 260, 2), 3), colour) + rng.normal(0, 0.01, 3)
        _lay(colours, shape, rng.uniform((-0.34, -0.20), (0.34, 0.30)), rng.uniform(0, np.pi))
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    marker = cv2.aruco.generateImageMarker(family, TAG_ID, TAG_TEXELS)
    sheet = np.pad(marker, TAG_TEXELS // 5, constant_values=255)[..., None] / 255 * 0.86 + 0.04
    # Texels of the tag stay where they are: it is not turned, and its edges lie between texels.
    left, top = (round(x) - len(sheet) // 2 for x in _texel(np.array(TAG)))
    colours[top : top + len(sheet), left : left + len(sheet)] = sheet
    return np.clip(colours, 0.02, 0.95)


def tag_centre() -> list[float]:
    """Where the middle of the tag comes to lie on whole texels [m]."""
    side = TAG_TEXELS + 2 * (TAG_TEXELS // 5)
    column, row = (round(x) - side // 2 + 0.5 * side for x in _texel(np.array(TAG)))
    return [column * SIDE / TEXELS - 0.5 * SIDE, 0.5 * SIDE - row * SIDE / TEXELS, 0.0]


def _texel(place: np.ndarray) -> np.ndarray:
    """Column and row of a place on the table [m]."""
    return (np.array([place[0], -place[1]]) + 0.5 * SIDE) * TEXELS / SIDE


def _lay(colours: np.ndarray, sheet: np.ndarray, middle: np.ndarray, turn: float) -> None:
    """Put a flat thing onto the table, turned."""
    import cv2

    height, width = sheet.shape[:2]
    reach = int(np.hypot(width, height) / 2) + 2
    column, row = _texel(middle)
    left, top = max(int(column) - reach, 0), max(int(row) - reach, 0)
    under = colours[top : int(row) + reach, left : int(column) + reach]
    cos, sin = np.cos(turn), np.sin(turn)
    linear = np.array([[cos, -sin], [sin, cos]])
    shift = (column - left, row - top) - linear @ (0.5 * np.array([width, height]))
    matrix = np.column_stack([linear, shift])
    size = (under.shape[1], under.shape[0])
    cover = cv2.warpAffine(np.ones((height, width)), matrix, size)[..., None]
    sheet = np.ascontiguousarray(sheet)
    under *= 1 - cover
    under += cover * cv2.warpAffine(sheet, matrix, size, borderMode=cv2.BORDER_REPLICATE)


def _newspaper(rng: np.random.Generator) -> np.ndarray:
    """A page: a headline, columns of words, a picture."""
    import cv2

    width, height = (round(side * TEXELS / SIDE) for side in PAPER)
    page = np.full((height, width, 3), SHEET, np.uint8)
    cv2.putText(page, " ".join(rng.choice(WORDS, 2)).upper(), (40, 110), cv2.FONT_HERSHEY_DUPLEX, 2.6, INK, 7)
    columns = 3
    for column in range(columns):
        left = 35 + column * (width - 50) // columns
        for row, top in enumerate(range(170, height - 30, 22)):
            line = " ".join(rng.choice(WORDS, 3))[:17]
            if row % 9:
                cv2.putText(page, line, (left, top), cv2.FONT_HERSHEY_SIMPLEX, 0.72, INK, 2)
    corner = rng.integers((200, 40), (height - 420, width - 420))
    picture = 128 + 64 * cv2.resize(rng.normal(size=(9, 9)), (370, 300), interpolation=cv2.INTER_CUBIC)
    page[corner[0] : corner[0] + 300, corner[1] : corner[1] + 370] = np.clip(picture, 25, 204)[..., None]
    return page / 255


def things(own: np.ndarray, seed: int) -> list[tuple[trimesh.Trimesh, list[float]]]:
    """A tin and a box behind the way, in colours of the object: meshes [m] and linear colours."""
    rng = np.random.default_rng(seed)
    tin = trimesh.creation.cylinder(0.033, 0.10, sections=64)
    tin.apply_translation([-0.23, 0.27, 0.05])
    box = trimesh.creation.box((0.11, 0.05, 0.07))
    box.apply_transform(trimesh.transformations.rotation_matrix(0.5, (0, 0, 1)))
    box.apply_translation([0.25, 0.25, 0.035])
    return [(thing, own[rng.integers(len(own))].tolist()) for thing in (tin, box)]


def hand() -> trimesh.Trimesh:
    """A hand with its forearm, fingers towards +y, the middle of the palm at the origin [m]."""

    def limb(start: tuple, end: tuple, radius: float) -> trimesh.Trimesh:
        """A capsule between two points."""
        a, b = np.array(start), np.array(end)
        capsule = trimesh.creation.capsule(float(np.linalg.norm(b - a)), radius, count=[16, 16])
        capsule.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), (b - a) / np.linalg.norm(b - a)))
        capsule.apply_translation(0.5 * (a + b))
        return capsule

    palm = trimesh.creation.icosphere(3)
    palm.apply_scale([0.042, 0.05, 0.016])
    fingers = [
        limb((0.02 * (k - 1.5), 0.035, 0.0), (0.026 * (k - 1.5), 0.105 - 0.008 * abs(k - 1.4), -0.018), 0.009)
        for k in range(4)
    ]
    thumb = limb((-0.03, -0.02, 0.0), (-0.072, 0.03, -0.012), 0.011)
    arm = limb((0.0, -0.04, 0.004), (0.04, -0.36, 0.05), 0.026)
    whole = trimesh.util.concatenate([palm, *fingers, thumb, arm])
    assert isinstance(whole, trimesh.Trimesh)
    return whole
