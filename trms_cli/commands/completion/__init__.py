"""``trms completion``: tab completion, as a script for the shell and the answers it asks for.

The script asks ``trms completion --query LINE`` for every press of tab; the answer comes from
:mod:`trms_cli.commands.completion.suggestions`, without Hydra.
"""

import sys
from collections.abc import Sequence

from trms_cli.core.errors import EXIT_OK, ConfigurationError

SUMMARY = "print the tab completion for bash, zsh or fish"

HELP = """\
usage: trms completion bash|zsh|fish

  Prints a script that completes commands, options, files, and for `trms run` the groups, their
  options, their keys and lists such as 'effect=[NAME,NAME]'.

examples
  source <(trms completion bash)                       for this shell
  echo 'source <(trms completion bash)' >> ~/.bashrc   for every new one
  source <(trms completion zsh)                        after compinit, in ~/.zshrc
  trms completion fish > ~/.config/fish/completions/trms.fish
"""

# Bash takes `=`, `:` and `@` as ends of a word (COMP_WORDBREAKS): what stands before the last
# of them must not come back, unless the word is quoted. What is replaced begins behind `=` and
# `:`, but with the `@` itself, which readline takes for the first letter of a host name. A word
# that goes on (`controller=`, `effect=[a`) gets no space.
_BASH = r"""
_trms_complete() {
    local line=${COMP_LINE:0:COMP_POINT} word kept reply
    word=${line##*[[:space:]]}
    kept=""
    case $word in
        [\'\"]*) ;;
        *[=:@]*) kept=${word%"${word##*[=:@]}"}; kept=${kept%@} ;;
    esac
    COMPREPLY=()
    while IFS= read -r reply; do
        COMPREPLY+=("${reply#"$kept"}")
        case $reply in
            *[=./,@] | *\[*[!\]]) compopt -o nospace 2>/dev/null ;;
        esac
    done < <("${COMP_WORDS[0]}" completion --query "$line" 2>/dev/null)
}
complete -F _trms_complete trms
"""

_ZSH = r"""
_trms_complete() {
    local -a replies
    local line="${(j: :)words[1,CURRENT-1]} $PREFIX"
    replies=("${(@f)$("${words[1]}" completion --query "$line" 2>/dev/null)}")
    [[ -n "$replies" ]] && compadd -Q -U -S '' -- "${replies[@]}"
}
compdef _trms_complete trms
"""

_FISH = r"""
complete -c trms -f -a '(trms completion --query (commandline -cp | string collect) 2>/dev/null)'
"""

SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}


def main(argv: Sequence[str]) -> int:
    """Print a shell's script, or the answers to its question."""
    if len(argv) == 2 and argv[0] == "--query":
        from trms_cli.commands.completion.suggestions import suggest

        sys.stdout.write("".join(f"{word}\n" for word in suggest(argv[1])))
        return EXIT_OK
    if len(argv) != 1 or argv[0] not in SCRIPTS:
        raise ConfigurationError(
            f"cannot use {' '.join(argv)!r}" if argv else "no shell given",
            where="trms completion",
            remedy=f"name one of: {', '.join(SCRIPTS)}",
        )
    sys.stdout.write(SCRIPTS[argv[0]].lstrip("\n"))
    return EXIT_OK
