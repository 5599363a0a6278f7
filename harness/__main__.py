"""The command ``tofpod PROGRAM ...`` runs every program; ``tofpod`` alone lists the most common
tasks."""

import importlib
import shlex
import sys
from typing import NamedTuple

from harness import __version__
from harness.vocabulary.errors import UserError, exit_code_of
from harness.vocabulary.files import shipped


class ProgramEntry(NamedTuple):
    """A program of the list below: what a user types, where it is, and what it does."""

    name: str
    module: str
    sentence: str


PROGRAMS = (
    ProgramEntry(
        "artefacts",
        "harness.programs.artefacts.artefacts",
        "makes stored answers again that are older than the code",
    ),
    ProgramEntry(
        "ask",
        "harness.programs.atlas.ask",
        "which camera finds a damage, at which distance, with how many frames, by stored limits",
    ),
    ProgramEntry(
        "atlas",
        "harness.programs.atlas.atlas",
        "computes the limits from which `ask` answers, camera by camera",
    ),
    ProgramEntry(
        "audit",
        "harness.programs.audit.audit",
        "how often everything that is quoted covers the truth",
    ),
    ProgramEntry(
        "characterise",
        "harness.programs.camera.characterise",
        "measures your own camera on static captures, as a page and a camera file",
    ),
    ProgramEntry(
        "check",
        "harness.programs.gate.check",
        "a gate that fails if a detection limit has become worse",
    ),
    ProgramEntry(
        "clean",
        "harness.programs.keeping.clean",
        "removes stored renders or results folders, after confirmation",
    ),
    ProgramEntry(
        "compare",
        "harness.programs.gate.compare",
        "compares two studies of detection limits, set-up by set-up, with paired tests",
    ),
    ProgramEntry(
        "coverage",
        "harness.programs.coverage.coverage",
        "where on a part damage is missed, and which poses cover most of it",
    ),
    ProgramEntry(
        "dataset",
        "harness.programs.dataset.dataset",
        "writes boards with masks to train and score on",
    ),
    ProgramEntry(
        "design",
        "harness.programs.inspections.design",
        "predicts what a planned study of detection limits can demonstrate",
    ),
    ProgramEntry(
        "detect",
        "harness.detect",
        "finds the damage in a real capture, prints a table and, with --out, writes files",
    ),
    ProgramEntry(
        "efficiency",
        "harness.programs.efficiency.efficiency",
        "compares every detector of a study with the ideal observer",
    ),
    ProgramEntry(
        "export",
        "harness.programs.dataset.export",
        "exports an experiment's simulated views, with truth, for other mapping programs",
    ),
    ProgramEntry(
        "export_noise",
        "harness.programs.camera.export_noise",
        "writes a camera's noise as a table and a file of code",
    ),
    ProgramEntry(
        "filters",
        "harness.programs.filters.filters",
        "states what a filter from depth to depth costs in detection limit, false calls and sizes",
    ),
    ProgramEntry(
        "flatfield",
        "harness.programs.camera.flatfield",
        "measures a unit's fixed pattern on captures of a flat surface",
    ),
    ProgramEntry(
        "gauge",
        "harness.programs.inspections.gauge",
        "designs boards with holes to check a detection limit: drilling template and truth",
    ),
    ProgramEntry(
        "implant",
        "harness.programs.implant.implant",
        "states your camera's detection limit on your part, by virtual damage in captures",
    ),
    ProgramEntry(
        "ls",
        "harness.programs.keeping.ls",
        "lists detectors and cameras with their settings, results folders, and stored renders",
    ),
    ProgramEntry(
        "merge",
        "harness.programs.cluster.merge",
        "joins the journals of shards and machines in one results folder",
    ),
    ProgramEntry(
        "pod",
        "harness.programs.inspections.pod",
        "fits the probability of detection to the user's own inspections (MIL-HDBK-1823A)",
    ),
    ProgramEntry(
        "record",
        "harness.programs.record.record",
        "records a depth camera, or a file, and says what its frames show",
    ),
    ProgramEntry(
        "score",
        "harness.programs.dataset.score",
        "states the detection limit of a method's anomaly maps",
    ),
    ProgramEntry(
        "start",
        "harness.programs.start.start",
        "asks for camera, part and damage, and writes an experiment and the commands to run",
    ),
    ProgramEntry("sweep", "harness.sweep", "runs an experiment and writes its report"),
    ProgramEntry(
        "target",
        "harness.target",
        "builds a target, prints its truth, and writes its mesh and truth",
    ),
    ProgramEntry(
        "train",
        "harness.programs.train.train",
        "trains the network of the detector `learned` on simulated boards",
    ),
    ProgramEntry(
        "validate",
        "harness.programs.scorecard.validate",
        "compares the simulated cameras with published figures, or with a real capture",
    ),
)
PART_OF_SET_UP = ProgramEntry(
    "prepare", "harness.programs.keeping.prepare", "compiles the inner loops once"
)
"""It runs as the others do and is not listed, because `make` calls it once."""
MODULES = {listed.name: listed.module for listed in (*PROGRAMS, PART_OF_SET_UP)}
TASKS = (
    ("be asked, and get an experiment with the commands to run", "tofpod start"),
    ("run an experiment and read its report", "tofpod sweep averaging"),
    ("state the smallest hole that a camera finds", "tofpod sweep detection_limit"),
    ("find the damage in your own capture", "tofpod detect captures/board --out findings"),
    (
        "state the limit of your own inspections",
        "tofpod pod inspections.csv --size length --hit found",
    ),
    ("list cameras and detectors with all their settings", "tofpod ls"),
)
COMPLETION = """\
_tofpod() {{
  local word="${{COMP_WORDS[COMP_CWORD]}}"
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W "{programs}" -- "$word"))
    return
  fi
  case "${{COMP_WORDS[1]}}" in
{options}
  esac
  [ ${{#COMPREPLY[@]}} -gt 0 ] || COMPREPLY=($(compgen -f -- "$word"))
}}
complete -o filenames -F _tofpod tofpod
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command. Returns the program's exit code, or 2 for an unknown program."""
    words = sys.argv[1:] if arguments is None else arguments
    name, *program_arguments = words or [""]
    if name in MODULES:
        sys.argv[1:] = program_arguments
        return int(
            importlib.import_module(MODULES[name]).main(
                program_arguments if arguments is not None else None
            )
        )
    return exit_code_of(lambda: _run(name, program_arguments))


def _run(name: str, program_arguments: list[str]) -> int:
    if name in ("", "-h", "--help"):
        wide = max(len(program.name) for program in PROGRAMS)
        print("How small a damage can a time-of-flight depth camera detect?\n")
        for task, command in TASKS:
            print(f"  {command:56}{task}")
        print("\nprograms (tofpod PROGRAM --help):\n")
        for program in PROGRAMS:
            print(f"  {program.name:{wide}}  {program.sentence}")
        print('\nshell completion: eval "$(tofpod completion bash)"')
        return 0
    if name == "--version":
        print(f"tofpod {__version__}")
        return 0
    if name == "completion":
        if program_arguments not in (["bash"], ["zsh"]):
            raise UserError(
                f"completion {shlex.join(program_arguments)}: no such shell",
                legal="tofpod completion bash, or zsh",
            )
        print(
            ("autoload -U bashcompinit && bashcompinit\n" if program_arguments == ["zsh"] else "")
            + _completion(),
            end="",
        )
        return 0
    from harness.vocabulary.words import nearest

    names = [program.name for program in PROGRAMS]
    nearest_name = nearest(name, names)
    fix = (
        f"did you mean {nearest_name}?" if nearest_name else "tofpod --help describes each program"
    )
    raise UserError(f"there is no program {name!r}", legal=", ".join(names), fix=fix)


def _completion() -> str:
    """Return a shell script that completes programs, options, experiments and cameras, and
    otherwise file names."""
    from scenes.sensor.camera import camera_names

    experiments = sorted(path.stem for path in shipped("experiments").glob("*.yaml"))
    cases = []
    for program in PROGRAMS:
        actions = importlib.import_module(program.module).main.parser()._actions
        words = [option for action in actions for option in action.option_strings]
        takes = {action.dest for action in actions}
        words += experiments if "experiment" in takes else []
        words += camera_names() if "camera" in takes else []
        cases.append(
            f'    {program.name}) COMPREPLY=($(compgen -W "{" ".join(words)}" -- "$word"));;'
        )
    return COMPLETION.format(
        programs=" ".join(program.name for program in PROGRAMS), options="\n".join(cases)
    )


if __name__ == "__main__":
    raise SystemExit(main())
