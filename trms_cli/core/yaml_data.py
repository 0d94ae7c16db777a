"""YAML as plain data, from whoever wrote it: bounded in size, depth and what aliases unfold to.

A YAML of a hundred bytes can unfold to gigabytes (aliases of aliases), and one of ten kilobytes can
nest so deeply that the reader's stack is used up and the process ends. So the events of a document
are counted before anything is built. Only plain types come out of it, never objects.
"""

from typing import Any

import yaml

#: A trained network with half a million weights has 10 MiB.
MOST_BYTES = 32 * 2**20
#: Values and collections, each alias counted as what it stands for.
MOST_NODES = 2_000_000
#: Collections in one another; configurations have up to eight.
DEEPEST = 50

_PARSER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the C one where it was built


class YamlRefused(yaml.YAMLError):
    """A document that is larger, deeper or stranger than what is read."""

    def __init__(self, problem: str, mark: yaml.Mark | None = None) -> None:
        super().__init__(problem)
        self.problem = problem
        self.problem_mark = mark


class _Loader(_PARSER):  # type: ignore[misc, valid-type]
    """Plain data; a key that stands twice is an error, not a loss."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge":
                if (key.tag, key.value) in keys:
                    raise YamlRefused(f"the key {key.value!r} stands twice", key.start_mark)
                keys.add((key.tag, key.value))
        return dict(super().construct_mapping(node, deep))


def mapping_in(document: str) -> dict[Any, Any]:
    """The mapping that a document is; empty for one that is none, or cannot be read."""
    try:
        content = load_yaml(document)
    except yaml.YAMLError:
        return {}
    return content if isinstance(content, dict) else {}


def load_yaml(document: bytes | str) -> Any:
    """The plain data of a document.

    Raises yaml.YAMLError if it is no YAML, holds a key twice or something that is no plain data, or
    is refused by :func:`check_yaml`.
    """
    check_yaml(document)
    try:
        return yaml.load(document, _Loader)
    except yaml.YAMLError:
        raise
    except Exception as error:  # a date that is none, a number of 5000 digits
        raise YamlRefused(f"a value cannot be read ({error})") from error


def check_yaml(document: bytes | str) -> None:
    """Refuse a document that would not fit into memory once it is read.

    Raises yaml.YAMLError if it is no YAML, or is larger than :data:`MOST_BYTES`, :data:`MOST_NODES`
    or :data:`DEEPEST` allow, or an alias stands inside of what it stands for.
    """
    if len(document) > MOST_BYTES:
        raise YamlRefused(
            f"it has {len(document) / 2**20:.0f} MiB, and {MOST_BYTES // 2**20} are read"
        )
    try:
        _count(document)
    except yaml.YAMLError:
        raise
    except (ValueError, RecursionError) as error:
        raise YamlRefused(str(error)) from error


def _count(document: bytes | str) -> None:
    total, anchors = 0, dict[str, int]()
    open_: list[tuple[str | None, int]] = []  # anchor of each collection, nodes before it
    for event in yaml.parse(document, _PARSER):
        if isinstance(event, yaml.AliasEvent):
            if any(anchor == event.anchor for anchor, _ in open_):
                raise YamlRefused(f"*{event.anchor} stands inside of itself", event.start_mark)
            total += anchors.get(event.anchor, 1)
        elif isinstance(event, yaml.ScalarEvent):
            total += 1
            if event.anchor:
                anchors[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            if len(open_) == DEEPEST:
                raise YamlRefused(f"it nests deeper than {DEEPEST} levels", event.start_mark)
            open_.append((event.anchor, total))
            total += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_.pop()
            if anchor:
                anchors[anchor] = total - before
        if total > MOST_NODES:
            raise YamlRefused(
                f"it unfolds to more than {MOST_NODES} values (aliases count as what they stand "
                "for)",
                event.start_mark,
            )
