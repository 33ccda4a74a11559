"""Shell completion of commands, options, choices and files.

Prints a script for the shell's start-up file. Completions come from the installed crosscue itself,
so they never differ from it.

examples:
  crosscue completion bash >> ~/.bashrc
  crosscue completion zsh >> ~/.zshrc
  crosscue completion fish > ~/.config/fish/completions/crosscue.fish
"""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Callable, Collection

SHELLS = ("bash", "zsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help="bash, zsh or fish")


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    from argcomplete.shell_integration import shellcode

    print(shellcode(["crosscue"], shell=args.shell))
    return 0


def complete(names: Collection[str], parser_of: Callable[[str], argparse.ArgumentParser]) -> None:
    """Answer the shell's script, if it asks, and exit.

    Args:
        names: All commands, of one or two words.
        parser_of: The parser of one command; its module is imported only then.
    """
    import argcomplete

    line = os.environ["COMP_LINE"][: int(os.environ["COMP_POINT"])]
    name, parser = _parser_at(line, names, parser_of)
    # argcomplete hands the parser the words after this many.
    os.environ["_ARGCOMPLETE"] = str(1 + len(name.split()))
    argcomplete.autocomplete(parser, always_complete_options="long")


def _parser_at(
    line: str, names: Collection[str], parser_of: Callable[[str], argparse.ArgumentParser]
) -> tuple[str, argparse.ArgumentParser]:
    """The words of the command before the cursor, and a parser of what follows them."""
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
    """Whole words before the cursor; the one that is being written does not count."""
    done = line if line[-1:].isspace() else line.rpartition(" ")[0]
    try:
        return shlex.split(done)
    except ValueError:
        return done.split()


def _choosing(words: Collection[str], *, with_files: bool) -> argparse.ArgumentParser:
    """A parser that takes one of a few words next, or a file."""
    from argcomplete.completers import FilesCompleter

    parser = argparse.ArgumentParser()
    word = parser.add_argument("word", help="command")
    files = FilesCompleter()

    def candidates(prefix: str, **rest: object) -> list[str]:
        return [*sorted(words), *(files(prefix) if with_files else ())]

    word.completer = candidates  # type: ignore[attr-defined]
    return parser
