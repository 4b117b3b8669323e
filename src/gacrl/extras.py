"""Packages that not everybody needs: an extra of the package installs them. A leaf, which imports none of them."""

from importlib.util import find_spec

from gacrl.errors import UserError


def require_extra(extra: str, *packages: str) -> None:
    """Raise UserError with what to install where one of the packages is not at hand."""
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise UserError(f"{' and '.join(missing)} must be installed for this: pip install 'gacrl[{extra}]'")
