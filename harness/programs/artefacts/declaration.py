"""The declared artefacts: stored files and quoted tables, how each is made, what it hangs on."""

import shlex
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from pydantic import Field

from harness.experiment.digests import camera_digests, experiment_digests
from harness.experiment.load import load_experiment
from harness.vocabulary import provenance
from harness.vocabulary.code_digests import DIGITS, Digests, code_digests, file_digests
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.diagnose import validated
from harness.vocabulary.declaration.yaml_source import DeclarationError, read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import digest
from harness.vocabulary.words import nearest
from scenes.sensor.camera import camera_names

FILE = Path(__file__).with_name("artefacts.yaml")
STUDIES = ("sweep", "check", "filters")
"""Programs of which the first argument is an experiment, whose digests count."""


class Across(Config):
    """A column of the data, each value of which is a column of the table."""

    column: str
    """Its name in the data."""
    head: str = "{}"
    """Format of the heads, such as ``{:g} m``."""


class QuotedTable(Config):
    """A table in a document. Formats name columns of the data: ``{a90_mm:.1f}``; ``!t`` turns the
    name of a camera into its title, ``!k`` the settings of a damage into its kind, ``!w`` any
    settings into words."""

    labels: dict[str, str]
    """Format of the leading cells by head; rows with equal labels are one row."""
    cells: dict[str, str]
    """Format of the further cells by head; with ``across`` they are repeated for each value."""
    across: Across | None = None
    """The column that runs along the table, if one does."""
    where: dict[str, str] = Field(default_factory=dict)
    """Columns and the value that the rows of the table have there."""
    absent: str = "–"
    """Format of a cell of which a number is missing."""


class Artefact(Config):
    """A stored answer."""

    about: str
    """What it says, in a line."""
    documents: tuple[str, ...] = ()
    """Documents that quote it between its markers; its table stands in the first of them."""
    commands: tuple[str, ...] = ()
    """What makes it, or tells by hand how it was made."""
    by_hand: bool = False
    """No command makes it again as a whole; `--made` states that a person has."""
    stores: dict[str, str] = Field(default_factory=dict)
    """Files of the repository, each with the file of results that it is a copy of."""
    writes: tuple[str, ...] = ()
    """Files of the repository that the commands write."""
    rows: tuple[str, ...] = ()
    """CSV files of results whose rows are the data of the table, which is stored."""
    table: QuotedTable | None = None
    """The table that the documents quote."""
    prints: bool = False
    """The documents quote the command with all that it prints, each time they are written; it takes
    a second."""
    of: tuple[str, ...] = ()
    """Artefacts that it is made of; it is as old as they are."""
    modules: tuple[str, ...] = ()
    """Modules that decide it, with all that they import, beside those of its experiments."""
    inputs: tuple[str, ...] = ()
    """Files of the repository that decide it; a folder counts with the Python below it."""
    every_camera: bool = False
    """The numbers of every camera decide it."""
    needs: tuple[str, ...] = ()
    """Programs and folders that its commands need."""
    seconds: float = Field(0.0, ge=0.0)
    """Expected seconds on two idle cores, until a run has measured them."""


class _File(Config):
    """The file of artefacts."""

    artefacts: dict[str, Artefact]
    """By name, in the order in which they are made: the most valuable first."""


def refuse_without_checkout() -> None:
    """Raise UserError where there are no documents, as in an installed wheel."""
    if not (provenance.ROOT / "docs").is_dir():
        raise UserError("there are no documents here", fix="run it in a checkout of tofpod")


@lru_cache
def declared_artefacts() -> Mapping[str, Artefact]:
    """Return the artefacts by name, in the order of the file. Raises DeclarationError."""
    file, problems = validated(_File, read_yaml(FILE), {})
    if file is None:
        raise DeclarationError(str(FILE), problems)
    return file.artefacts


def artefact_named(name: str) -> Artefact:
    """Return an artefact. Raises UserError for an unknown name."""
    artefacts = declared_artefacts()
    if name not in artefacts:
        similar = nearest(name, artefacts)
        suggestion = f"; did you mean {similar!r}?" if similar else ""
        message = f"there is no artefact {name!r}{suggestion}"
        raise UserError(message, legal=", ".join(artefacts))
    return artefacts[name]


def data_file(name: str) -> str:
    """Return the stored data of an artefact's table, relative to the repository."""
    return f"results/baselines/tables/{name}.csv"


def files_of(name: str) -> tuple[str, ...]:
    """Return the files that an artefact consists of, relative to the repository."""
    artefact = artefact_named(name)
    files = [*artefact.stores, *artefact.writes]
    if artefact.table is not None:
        files.append(data_file(name))
    return tuple(files)


def digests_today(name: str) -> Digests:
    """Return today's digests of all that an artefact hangs on, with the files of the artefacts
    that it is made of."""
    artefact = artefact_named(name)
    digests = code_digests(artefact.modules) | file_digests(artefact.inputs)
    for source in artefact.of:
        digests |= file_digests(files_of(source))
    if artefact.every_camera:
        digests |= camera_digests(camera_names())
    for command in artefact.commands:
        for part, part_digest in _command_digests(command).items():
            # two experiments may reach different modules of a room
            stored = digests.get(part, part_digest)
            if stored != part_digest:
                part_digest = digest([stored, part_digest])[:DIGITS]
            digests[part] = part_digest
    return digests


@lru_cache
def _command_digests(command: str) -> Digests:
    """Return the digests of the experiment that a command runs; none for other commands."""
    program, *words = shlex.split(command)
    if program != "tofpod" or words[0] not in STUDIES:
        return {}
    changes = [words[k + 1] for k, word in enumerate(words) if word == "--set"]
    experiment = load_experiment(provenance.ROOT / words[1], changes)
    return experiment_digests(experiment)
