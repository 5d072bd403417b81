"""``deal-hw --completion SHELL``: a script that completes verbs, kinds, options, choices and files on Tab.

The script holds every option, so that Tab does not start deal-hw. The shell completes files by itself.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator, Mapping

from deal_hw.cli.arguments import Option, options_of
from deal_hw.cli.verbs import Verb
from deal_hw.errors import ConfigurationError
from deal_hw.robots import driven_robots
from deal_hw.workflows.kinds import Kinds, one_kind

SHELLS = ("bash", "zsh")

_ZSH = """\
# zsh runs completions of bash.
autoload -Uz compinit bashcompinit
(( $+functions[compdef] )) || compinit
bashcompinit
"""

_SCRIPT = """\
# What can follow the words so far: verbs; kinds of a verb's input; options; the choices of an option. Where
# nothing fits, the shell offers files.
_deal_hw() {{
  local current="${{COMP_WORDS[COMP_CWORD]}}" previous="${{COMP_WORDS[COMP_CWORD-1]}}"
  local verb="${{COMP_WORDS[1]}}" kind="" word index offers="" kinds="" options=""
  COMPREPLY=()
  if [[ "$COMP_CWORD" == 1 ]]; then
    COMPREPLY=($(compgen -W "{verbs} --help --version --completion" -- "$current"))
    return
  fi
  case "$verb" in
{kinds}
  esac
  for ((index = 2; index < COMP_CWORD; index++)); do
    for word in $kinds; do [[ "${{COMP_WORDS[index]}}" == "$word" ]] && kind="$word"; done
  done
  case "$verb:$kind:$previous" in
{choices}
  esac
  if [[ -n "$offers" ]]; then
    COMPREPLY=($(compgen -W "$offers" -- "$current"))
    return
  fi
  case "$verb:$kind" in
{options}
  esac
  [[ "$current" == -* ]] && offers="$options --help"
  [[ "$current" != -* && -z "$kind" && "$previous" != -* ]] && offers="$kinds"
  [[ -z "$current" && "$previous" != -* ]] && offers="$offers $options"
  COMPREPLY=($(compgen -W "$offers" -- "$current"))
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
    kinds: list[str] = []
    options: list[str] = []
    choices: list[str] = []
    for name, verb in verbs.items():
        config = getattr(importlib.import_module(verb.module), verb.config)
        table = (config if isinstance(config, Kinds) else one_kind(config)).table()
        found = {word: list(options_of(kind.settings).values()) for word, kind in table.items()}
        for word, kind in table.items():
            base = kind.usage.partition(" ")[0]
            if kind.compound and base in found and word != base:
                # One of its options makes it this kind.
                found[base] = list({one.name: one for one in (*found[base], *found[word])}.values())
        first = [one for one in found.get("", ()) if one.positional and one.choices][:1]
        # A kind that a word and an option name together is found behind that word.
        own = [word for word, kind in table.items() if word and not kind.compound]
        words = [*own, *(choice for one in first for choice in one.choices)]
        if any(one.positional and one.name == "robot" for one in found.get("", ())):
            words = words or list(driven_robots())
        kinds.append(f'    {name}) kinds="{" ".join(words)}" ;;')
        # Without a known kind, such as behind a path: the options of all.
        every = {one.name: one for entries in found.values() for one in entries}
        for word, entries in {**found, "": [*every.values()]}.items():
            pattern = f"{name}:{word}" if word else f"{name}:*"
            options.append(f'    {pattern}) options="{" ".join(_flags(entries))}" ;;')
            choices += _choices(pattern, entries)
    script = _SCRIPT.format(
        verbs=" ".join(verbs), kinds="\n".join(kinds), options="\n".join(options), choices="\n".join(choices)
    )
    return (_ZSH if shell == "zsh" else "") + script


def _flags(options: Iterable[Option]) -> Iterator[str]:
    for one in options:
        yield from one.flags


def _choices(pattern: str, options: Iterable[Option]) -> Iterator[str]:
    """Yield the lines that offer the choices of options as their value."""
    for one in options:
        if one.choices and not one.positional:
            yield f'    {pattern}:{one.flags[0]}) offers="{" ".join(one.choices)}" ;;'
