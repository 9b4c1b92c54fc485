"""Signatures as Python has them: those of equinox modules do not stand in their source."""

import inspect

import griffe

import cfjax

PUBLIC = {
    f"{value.__module__}.{name}": value
    for name, value in inspect.getmembers(cfjax, inspect.isclass)
}
KINDS = {
    inspect.Parameter.POSITIONAL_OR_KEYWORD: griffe.ParameterKind.positional_or_keyword,
    inspect.Parameter.KEYWORD_ONLY: griffe.ParameterKind.keyword_only,
}


class Signatures(griffe.Extension):
    def on_class(self, *, cls, **_):
        if cls.path not in PUBLIC or inspect.isabstract(PUBLIC[cls.path]):
            return
        parameters = [griffe.Parameter("self", kind=KINDS[inspect.Parameter.POSITIONAL_OR_KEYWORD])]
        for p in inspect.signature(PUBLIC[cls.path]).parameters.values():
            default = None if p.default is p.empty else repr(p.default)
            parameters.append(griffe.Parameter(p.name, kind=KINDS[p.kind], default=default))
        cls.set_member(
            "__init__", griffe.Function("__init__", parameters=griffe.Parameters(*parameters))
        )
