"""YAML as OpenCV and ROS write it. Imported where such a file is read: few are, and PyYAML takes its time."""

from __future__ import annotations

import re

import yaml

_HEADER = re.compile(r"^%YAML[^\n]*\n?")


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's tagged matrices as plain mappings.

    cv2.FileStorage is not used to read: on damaged files it corrupts memory and takes the process along.
    """


def _opencv_mapping(loader: yaml.SafeLoader, _tag: str, node: yaml.Node) -> object:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "expected a matrix", node.start_mark)
    return loader.construct_mapping(node, deep=True)


_Loader.add_multi_constructor("tag:yaml.org,2002:opencv-", _opencv_mapping)


def first_document(text: str) -> object:
    """What a YAML text holds; None if it is empty.

    Raises:
        ValueError: it is no YAML.
    """
    # OpenCV 4.x writes "%YAML:1.0", which is no YAML, and 5.0 "%YAML 1.2".
    text = _HEADER.sub("", text.lstrip())
    try:
        # A dumped message ends in "---", an empty second document.
        return next(iter(yaml.load_all(text, _Loader)), None)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error
