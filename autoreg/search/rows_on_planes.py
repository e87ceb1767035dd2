"""Rows on the grounds that were looked into, and the bond that their cross joints may follow after all."""

from __future__ import annotations

import numpy as np

from autoreg.ground.ground_frame import with_origin
from autoreg.ground.sight import Looks
from autoreg.paving.bond import bond_of_places
from autoreg.paving.lattice_evidence import PLAIN_NATS, Paving
from autoreg.paving.lay import lay_bond
from autoreg.paving.plane_combs import PlaneCombs
from autoreg.rows.rows import Rows, lay_rows
from autoreg.segments import Segments
from autoreg.solve.freedom import Free


def fields_of_rows(
    looks: Looks, segments: Segments, size: tuple[int, int], planes: list[PlaneCombs]
) -> list[tuple[Rows, PlaneCombs]]:
    """The rows on some planes, with their planes, the clearest first."""
    fields = [(lay_rows(looks.picture, plane, segments, size), plane) for plane in planes]
    return clearest_first([(rows, plane) for rows, plane in fields if rows is not None])


def clearest_first(fields: list[tuple[Rows, PlaneCombs]]) -> list[tuple[Rows, PlaneCombs]]:
    """The same fields, the clearest first."""
    return sorted(fields, key=lambda field: -field[0].margin_nats)


def clearest_alone(fields: list[tuple[Rows, PlaneCombs]]) -> Rows | None:
    """The clearest of some rows whose cross joints are of no bond, nor of herringbone."""
    return next((rows for rows, _ in fields if not rows.in_columns), None)


def rows_alone(fields: list[tuple[Rows, PlaneCombs]]) -> Rows | None:
    """The clearest of these rows, if they do better than chance."""
    rows = clearest_alone(fields)
    return rows if rows is not None and rows.margin_nats > 0 else None


def plain_alone(fields: list[tuple[Rows, PlaneCombs]]) -> bool:
    """Whether the clearest rows, and their cross joints, are plain to see, and these of no bond.

    Those of a running bond lie in columns, even where its lattice is too uneven to be found.
    """
    if not fields:
        return False
    rows, _ = fields[0]
    return not rows.in_columns and min(rows.margin_nats, rows.paving.evidence_nats[1]) > PLAIN_NATS


def crossed(fields: list[tuple[Rows, PlaneCombs]]) -> bool:
    """Whether the cross joints between some rows are plain to see, so that no direction remains in doubt."""
    return any(rows.margin_nats > 0 and rows.paving.evidence_nats[1] > PLAIN_NATS for rows, _ in fields)


def by_cross_joints(looks: Looks, fields: list[tuple[Rows, PlaneCombs]], free: Free) -> tuple[Paving, ...]:
    """The lattice of the clearest rows, if their cross joints follow a law, though most are too faint.

    Seen from afar only some of a running bond's cross joints are found.
    """
    if not fields or fields[0][0].margin_nats <= 0:
        return ()
    rows, plane = fields[0]
    fit, middle = rows.paving.fit, rows.cross.middle
    width = fit.grid.spacing_y
    bond = bond_of_places(middle[:, 0], np.floor(middle[:, 1] / width).astype(int), width)
    if bond is None:
        return ()
    grid, phase = bond
    laid = lay_bond(looks, plane, with_origin(fit.cam_from_ground, phase, 0.0), grid, free)
    return () if laid is None else (laid,)
