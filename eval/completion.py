"""Shell completion of commands, options, choices and files."""

import argparse
import os
import shlex
from collections.abc import Callable, Collection
from typing import Annotated, Literal

from crosscue.verb import Option


def completion(
    shell: Annotated[Literal["bash", "zsh", "fish"], Option(metavar="SHELL")],
) -> str:
    """Print a completion script for bash, zsh or fish.

    It is meant for the shell's start-up file. The script asks the installed crosscue for
    completions, so they always match its version.

    Examples:
        crosscue completion bash >> ~/.bashrc
        crosscue completion zsh >> ~/.zshrc
        crosscue completion fish > ~/.config/fish/completions/crosscue.fish

    Args:
        shell: Shell: bash, zsh or fish.
    """
    from argcomplete.shell_integration import shellcode

    return shellcode(["crosscue"], shell=shell)


def complete(names: Collection[str], parser_of: Callable[[str], argparse.ArgumentParser]) -> None:
    """Print the completions that the shell's script asks for, and exit.

    Args:
        names: All commands, of one or two words.
        parser_of: Returns the parser of one command, whose module it imports.
    """
    import argcomplete

    line = os.environ["COMP_LINE"][: int(os.environ["COMP_POINT"])]
    name, parser = _parser_at(line, names, parser_of)
    # Number of leading words that argcomplete leaves out when it calls the parser.
    os.environ["_ARGCOMPLETE"] = str(1 + len(name.split()))
    argcomplete.autocomplete(parser, always_complete_options="long")


def _parser_at(
    line: str, names: Collection[str], parser_of: Callable[[str], argparse.ArgumentParser]
) -> tuple[str, argparse.ArgumentParser]:
    """Return the command's words before the cursor, and a parser for the words after them."""
    words = _words(line)[1:]
    for count in (2, 1):
        name = " ".join(words[:count])
        following = {other.split()[1] for other in names if other.startswith(f"{name} ")}
        if len(words) < count:
            continue
        if name in names and not (following and len(words) == count):
            return name, parser_of(name)
        if following:
            return name, _choosing(following, with_files=name in names)
    parser = _choosing({name.split()[0] for name in names}, with_files=False)
    parser.add_argument("--version", action="store_true", help="print the version")
    return "", parser


def _words(line: str) -> list[str]:
    done = line if line[-1:].isspace() else line.rpartition(" ")[0]
    try:
        return shlex.split(done)
    except ValueError:
        return done.split()


def _choosing(words: Collection[str], *, with_files: bool) -> argparse.ArgumentParser:
    """Return a parser whose next word is one of ``words`` or, optionally, a file."""
    from argcomplete.completers import FilesCompleter

    parser = argparse.ArgumentParser()
    word = parser.add_argument("word", help="command")
    files = FilesCompleter()

    def candidates(prefix: str, **rest: object) -> list[str]:
        return [*sorted(words), *(files(prefix) if with_files else ())]

    word.completer = candidates  # type: ignore[attr-defined]
    return parser
