"""``deal-hw --completion SHELL``: a script that completes verbs, options, choices and files on Tab.

The parser's own generator makes it. The script holds every option, so that Tab does not start deal-hw. The
generator knows no positional arguments: their names are added here, and the shell completes files by itself.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import operator
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import tyro

from deal_hw.cli.parsing import CONFIG, Rules
from deal_hw.errors import ConfigurationError

if typing.TYPE_CHECKING:
    from deal_hw.cli.main import Verb

SHELLS = ("bash", "zsh")

_ZSH = """\
# zsh runs completions of bash.
autoload -Uz compinit bashcompinit
(( $+functions[compdef] )) || compinit
bashcompinit
"""

_NAMES = """\

# Names of robots and benches behind the verb, and files where nothing else fits.
_deal_hw() {{
  local current="${{COMP_WORDS[COMP_CWORD]}}" verb="${{COMP_WORDS[1]}}" one
  local -a found
  _tyro_deal_hw
  # An empty word, for no match, would keep the shell from offering files.
  for one in "${{COMPREPLY[@]}}"; do [[ -n "$one" ]] && found+=("$one"); done
  if [[ "$COMP_CWORD" == 2 && "$current" != -* ]]; then
    case "$verb" in
{cases}
    esac
  fi
  COMPREPLY=("${{found[@]}}")
}}
complete -o default -F _deal_hw deal-hw
"""


def completion(shell: str, verbs: Mapping[str, Verb]) -> str:
    """Return the script for a shell.

    Args:
        shell: One of :data:`SHELLS`.
        verbs: The verbs of the command.

    Raises:
        ConfigurationError: Another shell is asked for.
    """
    if shell not in SHELLS:
        raise ConfigurationError(
            f"--completion {shell}: give {' or '.join(SHELLS)}, such as --completion bash"
        )
    configs = {
        name: getattr(importlib.import_module(verb.module), verb.config) for name, verb in verbs.items()
    }
    head = _ZSH if shell == "zsh" else ""
    return head + _of_all(configs) + _NAMES.format(cases="\n".join(_cases(configs)))


def _of_all(configs: Mapping[str, Any]) -> str:
    """Return the parser's script of a command whose sub-commands are the verbs."""
    parts = [
        Annotated[config, tyro.conf.subcommand(name, prefix_name=False)] for name, config in configs.items()
    ]
    everything: Any = functools.reduce(operator.or_, parts)
    written = io.StringIO()
    with contextlib.redirect_stdout(written), contextlib.suppress(SystemExit):
        tyro.cli(
            everything,
            prog="deal-hw",
            args=["--tyro-write-completion", "bash", "-"],
            config=CONFIG,
            registry=Rules(choices=True).registry,
        )
    return written.getvalue()


def _cases(configs: Mapping[str, Any]) -> list[str]:
    """Return the lines that offer names as a verb's first argument."""
    return [
        f'      {verb}) found+=($(compgen -W "{" ".join(names)}" -- "$current")) ;;'
        for verb, config in configs.items()
        if (names := _names(config))
    ]


def _names(config: Any) -> Sequence[str]:
    from deal_hw.robots import driven_robots

    if not isinstance(config, type):
        return ()
    for name, hint in typing.get_type_hints(config, include_extras=True).items():
        kind, *marks = typing.get_args(hint) or (hint,)
        if tyro.conf.Positional in marks:
            if typing.get_origin(kind) is Literal:
                return typing.get_args(kind)
            return driven_robots() if name == "robot" and kind is str else ()
    return ()
