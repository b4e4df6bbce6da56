"""The comment behind a field or a constant, which holds its unit and source, as its text in the API reference."""

import tokenize

import griffe

NOT_FOR_READERS = ("noqa", "type:", "fmt:")


class FieldComments(griffe.Extension):
    """Give what has no docstring the comment at the end of its line, as in `mass: float = 0.723  # [kg]`."""

    def __init__(self):
        self._comments = {}

    def on_attribute_instance(self, *, attr, **kwargs):
        """Called by griffe for each attribute; those that methods set on `self` are left alone."""
        if attr.docstring is None and attr.labels & {"class-attribute", "module-attribute"}:
            comment = self._in_file(attr.filepath).get(attr.endlineno, "")
            if comment and not comment.startswith(NOT_FOR_READERS):
                attr.docstring = griffe.Docstring(comment, lineno=attr.endlineno, parent=attr)

    def _in_file(self, path):
        if path not in self._comments:
            with tokenize.open(path) as source:
                tokens = list(tokenize.generate_tokens(source.readline))
            self._comments[path] = trailing_comments(tokens)
        return self._comments[path]


def trailing_comments(tokens):
    """Comments that stand behind code, {line number: text}."""
    return {
        token.start[0]: token.string.lstrip("# ")
        for token in tokens
        if token.type == tokenize.COMMENT and token.line[: token.start[1]].strip()
    }
