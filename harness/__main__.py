"""The command ``tofpod PROGRAM ...`` runs every program; ``tofpod`` alone lists the most common tasks."""

import ast
import importlib
import shlex
import sys
from functools import lru_cache
from pathlib import Path

from harness import __version__
from harness.vocabulary.errors import UserError, exit_code_of
from harness.vocabulary.files import shipped

PART_OF_SET_UP = "prepare"
TASKS = (
    ("run an experiment and read its report", "tofpod sweep averaging"),
    ("state the smallest hole that a camera finds", "tofpod sweep detection_limit"),
    ("find the damage in your own capture", "tofpod detect captures/board --out findings"),
    ("state the limit of your own inspections", "tofpod pod inspections.csv --size length --hit found"),
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
    given = sys.argv[1:] if arguments is None else arguments
    name, *rest = given or [""]
    if name in programs():
        sys.argv[1:] = rest
        return int(importlib.import_module(f"harness.{name}").main(rest if arguments is not None else None))
    return exit_code_of(lambda: _run(name, rest))


@lru_cache
def programs() -> dict[str, str]:
    """Return the programs by name, with the first sentence of each description."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("*.py")):
        # reading the source is faster than importing it, so that the list appears at once
        source = path.read_text(encoding="utf-8")
        if "\ndef main(" in source and path.stem not in ("__main__", PART_OF_SET_UP):
            text = ast.get_docstring(ast.parse(source)) or ""
            found[path.stem] = text.splitlines()[0].split(": ", 1)[-1].rstrip(".")
    return found


def _run(name: str, rest: list[str]) -> int:
    if name in ("", "-h", "--help"):
        wide = max(map(len, programs()))
        print("How small a damage can a time-of-flight depth camera detect?\n")
        for task, command in TASKS:
            print(f"  {command:56}{task}")
        print("\nprograms (tofpod PROGRAM --help):\n")
        for program, text in programs().items():
            print(f"  {program:{wide}}  {text}")
        print('\nshell completion: eval "$(tofpod completion bash)"')
        return 0
    if name == "--version":
        print(f"tofpod {__version__}")
        return 0
    if name == "completion":
        if rest not in (["bash"], ["zsh"]):
            raise UserError(f"completion {shlex.join(rest)}: no such shell", legal="tofpod completion bash, or zsh")
        print(("autoload -U bashcompinit && bashcompinit\n" if rest == ["zsh"] else "") + _completion(), end="")
        return 0
    from harness.vocabulary.declaration.diagnose import nearest

    near = nearest(name, programs())
    fix = f"did you mean {near}?" if near else "tofpod --help describes each program"
    raise UserError(f"there is no program {name!r}", legal=", ".join(programs()), fix=fix)


def _completion() -> str:
    """Return a shell script that completes programs, options, experiments and cameras, and otherwise file names."""
    from scenes.sensor.camera import camera_names

    experiments, cases = sorted(path.stem for path in shipped("experiments").glob("*.yaml")), []
    for program in programs():
        actions = importlib.import_module(f"harness.{program}").main.parser()._actions
        words = [option for action in actions for option in action.option_strings]
        takes = {action.dest for action in actions}
        words += experiments if "experiment" in takes else []
        words += camera_names() if "camera" in takes else []
        cases.append(f'    {program}) COMPREPLY=($(compgen -W "{" ".join(words)}" -- "$word"));;')
    return COMPLETION.format(programs=" ".join(programs()), options="\n".join(cases))


if __name__ == "__main__":
    raise SystemExit(main())
