"""The energy ledger: one table of its entries, and its balance.

At any time::

    sum(stored) = initial + sum(put in) - sum(taken out) - residual

where the residual is what the balance leaves unexplained. Every other entry is integrated from
its own force. All entries in J.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from derail_ros.vocabulary.words import energy, joined

STORED = "stored"
INITIAL = "initial"
TAKEN = "taken out"
PUT = "put in"
CHECK = "check"
ROLES = (STORED, INITIAL, TAKEN, PUT, CHECK)
"""What an entry is to the balance. Entries ``put in`` are signed, ``taken out`` is positive where
the train lost energy, ``check`` is outside the balance."""


@dataclass(frozen=True)
class EnergyEntry:
    """An entry of the ledger.

    Attributes
    ----------
    key : its name, everywhere
    role : one of :data:`ROLES`
    words : for a taker what took the energy ("the brakes"), else what the entry is
    """

    key: str
    role: str
    words: str


ENERGY_ENTRIES: dict[str, EnergyEntry] = {
    e.key: e
    for e in (
        EnergyEntry("kinetic", STORED, "kinetic energy"),
        EnergyEntry("striker", STORED, "elastic energy of the striker springs"),
        EnergyEntry("knuckle", STORED, "elastic energy of the mated coupler heads"),
        EnergyEntry("draft_gear", STORED, "elastic energy of the draft gear"),
        EnergyEntry("suspension", STORED, "elastic energy of trucks on the rails"),
        EnergyEntry("potential", STORED, "potential energy, over that at the start"),
        EnergyEntry("initial", INITIAL, "kinetic and elastic energy at the start"),
        EnergyEntry("brakes", TAKEN, "the brakes"),
        EnergyEntry("ground_trucks", TAKEN, "the ground under derailed trucks"),
        EnergyEntry("ground_body", TAKEN, "the ground under uncoupled cars"),
        EnergyEntry("slopes", TAKEN, "slopes beside the track"),
        EnergyEntry("collisions", TAKEN, "collisions between cars"),
        EnergyEntry("fixed_bodies", TAKEN, "walls and other fixed bodies"),
        EnergyEntry("striker_dampers", TAKEN, "damping of the strikers"),
        EnergyEntry("suspension_dampers", TAKEN, "trucks and rails"),
        EnergyEntry("guidance", TAKEN, "rails beside derailed trucks"),
        EnergyEntry("draft_gear_friction", TAKEN, "friction of the draft gear"),
        EnergyEntry("dynamic_brake", TAKEN, "the dynamic brake"),
        EnergyEntry("resistance", TAKEN, "rolling, air and curve resistance"),
        EnergyEntry("knuckles_released", TAKEN, "couplings that parted"),
        EnergyEntry("external", PUT, "the force that starts the motion"),
        EnergyEntry("traction", PUT, "locomotives"),
        EnergyEntry("stabilization_net", PUT, "constraint stabilization (numerical)"),
        EnergyEntry("stabilization_gross", CHECK, "constraint stabilization, summed by size"),
        EnergyEntry("residual", CHECK, "what the balance leaves unexplained"),
    )
}
"""All entries, in the order of tables, messages and files. An engine gives those it knows."""


def entries(role: str) -> tuple[EnergyEntry, ...]:
    """The entries with a role, in the order of the table."""
    return tuple(e for e in ENERGY_ENTRIES.values() if e.role == role)


def residual(ledger: Mapping[str, float]) -> float:
    """Unexplained rest of the balance, J; missing entries count as 0."""
    total = {
        role: sum(ledger.get(e.key, 0.0) for e in entries(role))
        for role in (INITIAL, PUT, TAKEN, STORED)
    }
    return total[INITIAL] + total[PUT] - total[TAKEN] - total[STORED]


def available(ledger: Mapping[str, float]) -> float:
    """Energy that the train had to lose, J: at the start, from locomotives, and from its fall."""
    pulled, height = (ledger.get(key) or 0.0 for key in ("traction", "potential"))
    gained = max(pulled, 0.0) + max(-height, 0.0)
    return (ledger.get("initial") or 0.0) + gained


def shares(ledger: Mapping[str, float]) -> list[tuple[EnergyEntry, float, float]]:
    """Losses of energy: entry, J, share of the energy put in (nan without); largest first."""
    total = available(ledger)
    rows = [
        (e, ledger[e.key], ledger[e.key] / total if total > 0.0 else math.nan)
        for e in entries(TAKEN)
        if ledger.get(e.key) is not None
    ]
    return sorted(rows, key=lambda row: -row[1])


def percentages(values: Sequence[float]) -> list[int]:
    """Shares as whole percentages that add up to their rounded sum (largest remainder)."""
    floors = [math.floor(100.0 * v) for v in values]
    missing = round(100.0 * sum(values)) - sum(floors)
    order = sorted(range(len(values)), key=lambda i: floors[i] - 100.0 * values[i])
    for i in order[:missing]:
        floors[i] += 1
    return floors


SMALL_SHARE = 0.005
"""Takers below this share of the energy are named without a number."""
NO_ENERGY = 0.5
"""A taker below this would be written as 0 J and is left out, J."""


def stopped_by(ledger: Mapping[str, float]) -> str:
    """What stopped the train, in a sentence or two."""
    ranked = [row for row in shares(ledger) if math.isfinite(row[2])]
    if not ranked:
        return "The energy ledger is not known."
    total = available(ledger)
    more = [("traction", "from locomotives", 1.0), ("potential", "from the grade", -1.0)]
    came = [words for key, words, sign in more if sign * (ledger.get(key) or 0.0) > NO_ENERGY]
    opening = f"Of the {energy(total)} {joined(['at the start', *came])}"
    large = [row for row in ranked if row[2] >= SMALL_SHARE]
    if not large:
        return f"{opening} nothing has been taken out yet."
    left = (ledger.get("kinetic") or 0.0) / total
    parts = [(e.words, s) for e, _, s in large]
    if left >= SMALL_SHARE:
        parts.append(("still motion", left))
    numbers = percentages([s for _, s in parts])
    main = [f"{words} {n} %" for (words, _), n in zip(parts[: len(large)], numbers)]
    text = f"{opening}, these took: {joined(main)}"
    if left >= SMALL_SHARE:
        text += f"; {numbers[-1]} % is still motion"
    text += "."
    small = [e.words for e, j, s in ranked if j >= NO_ENERGY and s < SMALL_SHARE]
    if small:
        text += f" Less than half a percent each: {joined(small)}."
    return text
