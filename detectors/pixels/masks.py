"""Operations on masks (h, w) bool: enclosed areas, rims, connected parts and nearest pixels."""

import cv2
import numba
import numpy as np
from scipy import ndimage

from detectors.pixels.clusters import PLAIN, root_of


def on_grid(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return an image (h, w) with the values (n,), in order, at the true pixels of the mask, and
    NaN elsewhere."""
    image = np.full(mask.shape, np.nan)
    image[mask] = values
    return image


def holes_filled(mask: np.ndarray, rim_px: int = 0) -> np.ndarray:
    """Return the mask with everything that it encloses, and an empty rim of 0 or 1 pixels."""
    image = np.zeros((mask.shape[0] + 2, mask.shape[1] + 2), np.uint8)
    image[1:-1, 1:-1] = mask
    cv2.floodFill(image, None, (0, 0), 2)
    if not rim_px:
        image = image[1:-1, 1:-1]
    return image != 2


def notches_filled(mask: np.ndarray, radius_px: int) -> np.ndarray:
    """Return the mask, which encloses its holes, without the notches of its outline. Notches are
    gaps that a closing with a disc of ``radius_px`` fills and that hold a disc of a quarter of
    that radius, as a hole cut by the edge does. The roundings that a closing leaves in
    right-angled corners only hold a smaller disc (0.17)."""

    def deep_in(gaps: np.ndarray) -> np.ndarray:
        padded = np.pad(gaps, 1).astype(np.uint8)
        depth_px = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
        return depth_px > 1 + radius_px / 4

    # a closing is slow and stays within the convex hull, so it is computed only there
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return mask
    first = mask[rows].argmax(axis=1)
    last = mask.shape[1] - 1 - mask[rows, ::-1].argmax(axis=1)
    ends = np.column_stack([np.append(first, last), np.tile(rows, 2)])
    outline = cv2.convexHull(ends.astype(np.int32))
    hull = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), outline, 1)
    if not deep_in(hull > mask).any():
        return mask
    side = 2 * radius_px + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    padded = np.pad(mask.astype(np.uint8), side)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, kernel)[side:-side, side:-side]
    gaps = holes_filled(closed > 0) & ~mask
    return mask | parts_with(gaps, deep_in(gaps), connectivity=4)


def grown(
    mask: np.ndarray,
    pixels: int,
    shape: int = cv2.MORPH_RECT,
) -> np.ndarray:
    """Return the mask grown by all pixels within this distance: in a square, or in OpenCV's
    ``shape``."""
    kernel = cv2.getStructuringElement(shape, (2 * pixels + 1, 2 * pixels + 1))
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0


def shrunk(mask: np.ndarray, side: int) -> np.ndarray:
    """Return the pixels whose square of ``side`` pixels lies inside the mask; beyond the picture
    counts as inside."""
    return cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def inset(mask: np.ndarray, pixels: int) -> np.ndarray:
    """Remove ``pixels`` pixels from the mask's outer rim. Holes inside do not grow; the picture's
    edge is not a rim."""
    if pixels == 0:
        return mask
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    # OpenCV's default border never erodes
    return mask & cv2.erode(holes_filled(mask).astype(np.uint8), kernel).astype(bool)


def parts_with(
    mask: np.ndarray,
    seeds: np.ndarray,
    connectivity: int = 8,
    least: int = 0,
) -> np.ndarray:
    """Return the connected parts of the mask that hold a seed (h, w) and at least ``least``
    pixels."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=connectivity)
    has_seed = np.zeros(count, dtype=bool)
    has_seed[labels[seeds & mask]] = True
    if least:
        has_seed &= np.bincount(labels.ravel(), minlength=count) >= least
    has_seed[0] = False
    return has_seed[labels]


def outline_depth_px(known: np.ndarray) -> np.ndarray:
    """Return the distance (h, w) of each pixel to the outline of the known pixels, ignoring single
    unknown pixels."""
    padded = cv2.copyMakeBorder(known.astype(np.uint8), 2, 2, 2, 2, cv2.BORDER_CONSTANT)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return np.ascontiguousarray(cv2.distanceTransform(closed, cv2.DIST_C, 3)[2:-2, 2:-2])


def rim_distance_px(mask: np.ndarray) -> np.ndarray:
    """Return the distance (h, w) of each pixel of a mask to its rim; the image's own edge does not
    count as a rim."""
    return ndimage.distance_transform_edt(np.pad(mask, 1, mode="edge"))[1:-1, 1:-1]


def nearest_pixel(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each pixel's distance (h, w) to the mask, in pixels, and the flat index of the mask's
    nearest pixel."""
    beyond = (~mask).astype(np.uint8)
    distance_px, labels = cv2.distanceTransformWithLabels(
        beyond,
        cv2.DIST_L2,
        3,
        labelType=cv2.DIST_LABEL_PIXEL,
    )
    inside = np.flatnonzero(mask)
    pixel_of_label = np.zeros(len(inside) + 1, dtype=np.int64)
    pixel_of_label[labels.reshape(-1)[inside]] = inside
    return distance_px, pixel_of_label[labels]


def components(
    nodes: np.ndarray,
    right: np.ndarray,
    down: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Number the sets of nodes (h, w) that links join, largest first; return the numbers (h, w)
    and the sizes. ``right`` and ``down`` (h, w) bool: whether a pixel is linked to the next in its
    row and in its column."""
    sets, sizes = _sets_of_nodes(nodes, right, down)
    order = np.argsort(-sizes, kind="stable")
    number = np.zeros(len(sizes) + 1, dtype=np.int32)
    number[order + 1] = np.arange(1, len(sizes) + 1)
    return number[sets], sizes[order]


@numba.njit(**PLAIN)
def _sets_of_nodes(
    nodes: np.ndarray, right: np.ndarray, down: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the number (h, w) of each node's set, from 1 in the order of their first pixels, 0
    beside nodes, and the sets' sizes.

    A node takes the number of the node on its left or above it; where it joins two numbers, the
    higher one gets the lower one as its parent."""
    height, width = nodes.shape
    sets = np.zeros((height, width), np.int32)
    parents = np.zeros(height * width + 1, np.int64)
    count = 0
    for v in range(height):
        for u in range(width):
            if not nodes[v, u]:
                continue
            beside = 0
            if u > 0 and right[v, u - 1]:
                beside = sets[v, u - 1]
            above = 0
            if v > 0 and down[v - 1, u]:
                above = sets[v - 1, u]
            if beside == 0 and above == 0:
                count += 1
                parents[count] = count
                sets[v, u] = count
            elif beside == 0 or above == 0 or beside == above:
                sets[v, u] = max(beside, above)
            else:
                first = root_of(parents, beside)
                second = root_of(parents, above)
                parents[max(first, second)] = min(first, second)
                sets[v, u] = min(first, second)
    # parents have lower numbers, so that each one's final number is known before its children's
    final = np.zeros(count + 1, np.int32)
    sizes = np.zeros(count + 1, np.int64)
    kept = 0
    for number in range(1, count + 1):
        if parents[number] == number:
            kept += 1
            final[number] = kept
        else:
            final[number] = final[parents[number]]
    for v in range(height):
        for u in range(width):
            number = final[sets[v, u]]
            sets[v, u] = number
            sizes[number] += 1
    return sets, sizes[1 : kept + 1]
