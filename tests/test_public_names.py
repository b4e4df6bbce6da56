"""The names that the packages offer are the objects they promise, whatever was imported before."""

from importlib import import_module

import pytest

import adapt
import envs


@pytest.mark.parametrize("package", [adapt, envs])
def test_every_public_name_is_there_and_no_module_hides_it(package):
    for home in set(package._HOMES.values()):
        import_module(f"{package.__name__}.{home}")
    for name in package.__all__:
        value = getattr(package, name)
        assert callable(value) or isinstance(value, dict), f"{package.__name__}.{name} is {value!r}"


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = adapt.no_such_name
