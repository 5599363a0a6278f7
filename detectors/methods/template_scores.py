"""The scores of all templates of the matched filters, of which each pixel keeps the strongest."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

import cv2
import numba
import numpy as np

from detectors.findings import templates, whitening
from detectors.methods import local, slots
from detectors.methods.deviations import RIM_PX
from detectors.methods.scatter import FAINT, evened, tail_of, zones_of
from detectors.pixels.clusters import PLAIN
from detectors.pixels.masks import outline_depth_px

ROUGH = 0.4  # error at which C^-1 r is solved for strong findings, as `whitening.CONVERGED`
LEAST_SEEN = 0.6  # least visible share of a template
TAIL_PX = 1.5
"""Largest radius at which a template's own scores show their tail. Wider means are near Gaussian,
and too few of them are independent."""


class TemplateNoise(NamedTuple):
    """The worth of templates under a noise."""

    window_px: int
    """Side of the camera's window that the noise indicates."""
    worths: tuple[templates.Worth, ...]
    """Worth of each template."""
    slot_energies: np.ndarray
    """Whitened energies of slots (`slots.energies`)."""


def template_noise(covariance: np.ndarray) -> TemplateNoise:
    """Return what noise with an autocovariance by lag makes of the templates: computed once for
    all pictures that are judged by the same learned covariance."""
    return _template_noise(covariance.tobytes(), covariance.shape, covariance.dtype.str)


@lru_cache(maxsize=4)
def _template_noise(values: bytes, shape: tuple[int, ...], kind: str) -> TemplateNoise:
    covariance = np.frombuffer(values, kind).reshape(shape)
    window_px = templates.window_of(covariance)
    power = whitening.spectrum(covariance, (whitening.GRID, whitening.GRID))
    return TemplateNoise(
        window_px=window_px,
        worths=templates.worths(power, window_px),
        slot_energies=slots.energies(power, window_px),
    )


class PictureNoise(NamedTuple):
    """The noise of a picture."""

    filters: whitening.Filters
    """Its covariance."""
    rim: np.ndarray
    """(r, c): variance of independent pixels whose means over `BLOCK_PX` vary as those at their
    distance from the outline do beyond it."""
    on_templates: TemplateNoise
    """The worth of templates under it."""

    @property
    def bank(self) -> tuple[templates.Template, ...]:
        """The templates as seen through the camera's window."""
        return templates.bank(self.on_templates.window_px)


class Scores(NamedTuple):
    """The strongest template at each pixel."""

    signed: np.ndarray
    """(r, c): its score, negative in front of the surface."""
    template: np.ndarray
    """(r, c): its number in the bank."""
    solved: np.ndarray
    """(r, c): C^-1 r."""
    deviations: np.ndarray
    """(t,): deviation of each template's scores."""


class _SeenGrid:
    """The seen pixels, all or halved to every second one, as templates are compared with them.

    ``seen`` (r, c) float32: 1 where seen, a share where halved. ``depth_px`` (r, c): distance from
    the outline of the seen pixels. ``spectrum``: of C^-1 r on the grid of transforms. ``score``
    (r, c) and ``products``: memory for one template's scores and one pair's transform."""

    def __init__(
        self,
        seen: np.ndarray,
        depth_px: np.ndarray,
        spectrum: np.ndarray,
    ) -> None:
        self.seen = seen
        self.depth_px = depth_px
        self.spectrum = spectrum
        self.score = np.empty_like(seen)
        self.products = np.empty_like(spectrum)
        self._factors: dict[tuple[bool, tuple[int, int]], np.ndarray] = {}

    def factors(self, template: templates.Template, worth: templates.Worth) -> np.ndarray:
        """Return 1 / sqrt(visible share) (r, c) of a template, 0 where it does not judge."""
        key = template.slot is not None, worth.sides
        if key not in self._factors:
            share = cv2.blur(self.seen, worth.sides, borderType=cv2.BORDER_CONSTANT)
            judged = self.seen
            if template.slot is not None:
                # errors along outlines, from light and flying pixels, look like slots
                judged = judged * (self.depth_px > RIM_PX)
            self._factors[key] = _visible(share, judged)
        return self._factors[key]


class _Best:
    """The strongest score (r, c) at each pixel so far, with its sign, and its template's number."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.signed = np.zeros(shape, np.float32)
        self.template = np.zeros(shape, np.uint8)


def scored(
    values: np.ndarray,
    seen: np.ndarray,
    noise: PictureNoise,
    strong: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> Scores:
    """Return each pixel's strongest score.

    Args:
        values: (r, c), residuals in deviations.
        seen: (r, c) bool, the pixels that count.
        noise: of the picture.
        strong: (r, c) bool, strong findings, which the scatter of scores ignores. None in the
            first pass, which looks for them: at the centres of pixels, with deviations of 1.
        start: (r, c), an approximate C^-1 r."""
    error = ROUGH if strong is None else whitening.CONVERGED
    solved = whitening.inverse_times(values, seen, noise.filters, start, error, noise.rim)
    fine = _SeenGrid(
        seen.astype(np.float32),
        outline_depth_px(seen),
        templates.transformed(solved, noise.filters.power.shape),
    )
    coarse = _SeenGrid(_halved(fine.seen), _halved(fine.depth_px), templates.halved(fine.spectrum))
    zones = []
    if strong is not None:
        zones.append(zones_of(fine.seen, fine.depth_px, strong))
        coarse_strong = np.ascontiguousarray(strong[::2, ::2])
        zones.append(zones_of(coarse.seen, coarse.depth_px, coarse_strong))
    best = _Best(fine.seen.shape)
    coarse_best = _Best(coarse.seen.shape)
    slot_best = _Best(coarse.seen.shape)
    tail = 1.0
    deviations = np.ones(len(noise.bank))
    slot_responses = {}
    for view, number, response in _responses(fine, coarse, noise, strong is None):
        template = noise.bank[number]
        worth = noise.on_templates.worths[number]
        score = view.score
        if template.slot is not None:
            slot_responses[number] = response.copy()
        factors = view.factors(template, worth)
        cv2.multiply(response, factors, dst=score, scale=worth.energy**-0.5)
        deviation = 1.0
        if strong is not None:
            deviation = evened(score, template, zones[template.coarse])
            if template.radius_px <= TAIL_PX:
                if not any(template.halves):
                    tail = tail_of(score, deviation)
                deviation *= tail
        deviations[number] = deviation
        kept = best
        if template.coarse:
            kept = coarse_best if template.slot is None else slot_best
        down, right = template.halves
        keep_stronger(
            kept.signed,
            kept.template,
            score,
            1 / deviation,
            worth.raised,
            down,
            right,
            number,
        )
    # errors along outlines, from light and flying pixels, look like slots
    blurred = slots.blurred(solved, noise.on_templates.window_px) * (fine.depth_px > RIM_PX)
    refined = _refined_slots(slot_best, slot_responses, blurred, noise)
    # linear interpolation would lower the narrow ridges of slots' scores by a seventh
    _merge(best, coarse_best, cv2.INTER_LINEAR)
    slot_best.signed = slots.lowered(slot_best.signed)
    _merge(best, slot_best, cv2.INTER_NEAREST)
    for slot, number in refined:
        _draw(best, slot, number)
    return Scores(best.signed * seen, best.template, solved, deviations)


def _refined_slots(
    slot_best: _Best,
    responses: Mapping[int, np.ndarray],
    blurred: np.ndarray,
    noise: PictureNoise,
) -> list[tuple[slots.BestSlot, int]]:
    """Return the best slots around the peaks of the bank's, with their final scores, and the
    number of the bank's slot there.

    Args:
        slot_best: the bank's, on the halved picture.
        responses: (r / 2, c / 2) of each of them.
        blurred: (r, c), of `slots.blurred`.
        noise: of the picture."""
    refined = []
    for row, column in slots.peaks_of(slot_best.signed).tolist():
        number = int(slot_best.template[row, column])
        sides = noise.bank[number].slot
        assert sides is not None
        score = float(slot_best.signed[row, column])
        slot = slots.best_slot(
            blurred,
            noise.on_templates.slot_energies,
            (2 * row + 0.5, 2 * column + 0.5),
            sides,
            math.copysign(1.0, score),
        )
        # what is seen there, the deviation of scores and how it differs there are those of the
        # bank's slot: of the other widths the deviations differ by up to 4 %
        response = (
            float(responses[number][row, column]) * noise.on_templates.worths[number].energy ** -0.5
        )
        final = slots.lowered(np.array(score / response * slot.score))
        refined.append((slot._replace(score=float(final)), number))
    return refined


def _draw(best: _Best, slot: slots.BestSlot, number: int) -> None:
    """Raise the scores along a slot, so that it is one finding with its peak in the middle. A slot
    that reaches over stronger evidence has its own from there, and is left out."""
    half_px = slot.length_px / 2
    along = np.arange(-half_px, half_px + 0.5, 0.5)
    angle_rad = math.radians(slot.angle_deg)
    rows = np.rint(slot.row + math.sin(angle_rad) * along).astype(int)
    columns = np.rint(slot.column + math.cos(angle_rad) * along).astype(int)
    height, width = best.signed.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    on_grid = (rows[inside], columns[inside])
    # just above the saddle at which peaks are joined
    scores = np.full(len(along), local.SADDLE * 1.01 * slot.score, np.float32)
    scores[len(along) // 2] = slot.score
    scores = scores[inside]
    earlier = best.signed[on_grid]
    if np.abs(earlier).max(initial=0.0) > abs(slot.score):
        return
    stronger = np.abs(scores) > np.abs(earlier)
    best.signed[on_grid] = np.where(stronger, scores, earlier)
    best.template[on_grid] = np.where(stronger, number, best.template[on_grid])


def _responses(
    fine: _SeenGrid,
    coarse: _SeenGrid,
    noise: PictureNoise,
    only_centred: bool,
) -> Iterator[tuple[_SeenGrid, int, np.ndarray]]:
    """Yield for each template the view on which it is scored, its number, and its response t' C^-1
    r (r, c), which the next one overwrites."""
    bank = noise.bank
    for pair, numbers in templates.spectra(noise.filters.power.shape, noise.on_templates.window_px):
        if only_centred and all(any(bank[number].halves) for number in numbers):
            continue
        view = coarse if bank[numbers[0]].coarse else fine
        height, width = view.seen.shape
        pair_response = templates.responses(view.spectrum, pair, view.products)[:height, :width]
        for channel, number in enumerate(numbers):
            if only_centred and any(bank[number].halves):
                continue
            cv2.extractChannel(pair_response, channel, dst=view.score)
            yield view, number, view.score


def _halved(image: np.ndarray) -> np.ndarray:
    """Return the means (r / 2, c / 2) of 2 x 2 pixels; an odd last row or column is repeated."""
    odd_rows = image.shape[0] % 2
    odd_columns = image.shape[1] % 2
    even = cv2.copyMakeBorder(image, 0, odd_rows, 0, odd_columns, cv2.BORDER_REPLICATE)
    return cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def _merge(best: _Best, halved: _Best, interpolation: int) -> None:
    """Keep the stronger of scores at all pixels and those of the halved picture."""
    height, width = best.signed.shape
    signed = cv2.resize(halved.signed, None, fx=2, fy=2, interpolation=interpolation)
    signed = np.ascontiguousarray(signed[:height, :width])
    template = cv2.resize(
        halved.template,
        None,
        fx=2,
        fy=2,
        interpolation=cv2.INTER_NEAREST,
    )
    template = np.ascontiguousarray(template[:height, :width])
    stronger = (np.abs(signed) > np.abs(best.signed)).view(np.uint8)
    cv2.copyTo(signed, stronger, best.signed)
    cv2.copyTo(template, stronger, best.template)


@numba.njit(**PLAIN)
def _visible(share: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Return 1 / sqrt(share) (r, c) where ``judged`` is not 0 and enough of a template is visible,
    0 elsewhere."""
    factors = np.empty(share.shape, np.float32)
    least = np.float32(LEAST_SEEN)
    for i in range(share.shape[0]):
        share_row = share[i]
        judged_row = judged[i]
        row = factors[i]
        for j in range(len(row)):
            factor = np.float32(1.0) / np.sqrt(max(share_row[j], least))
            is_judged = (share_row[j] > least) & (judged_row[j] > 0)
            row[j] = factor if is_judged else np.float32(0.0)
    return factors


@numba.njit(**PLAIN)
def keep_stronger(  # type: ignore[no-untyped-def]
    signed,
    by,
    score,
    per_deviation,
    raised,
    down,
    right,
    number,
):
    """Keep the larger of each pixel's scores (r, c) by size in ``signed``, and that template's
    ``number`` in ``by``.

    Scores are scaled by ``per_deviation`` and raised: their squares grow by ``raised``, in
    proportion below `FAINT`. Scores between pixels, ``down`` or ``right``, belong to all around.
    """
    scale = np.float32(per_deviation)
    raised_by = np.float32(raised)
    faint = np.float32(per_deviation * np.sqrt(1.0 + raised / FAINT**2))
    height, width = score.shape
    for y in range(down + 1):
        for x in range(right + 1):
            for i in range(height - y):
                row = score[i]
                kept = signed[i + y][x:]
                kept_by = by[i + y][x:]
                for j in range(width - x):
                    size = min(abs(row[j]) * faint, np.sqrt((row[j] * scale) ** 2 + raised_by))
                    stronger = size > abs(kept[j])
                    kept[j] = np.copysign(size, row[j]) if stronger else kept[j]
                    kept_by[j] = number if stronger else kept_by[j]
