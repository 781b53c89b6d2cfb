# SPDX-License-Identifier: Apache-2.0
"""Import of Numba without the settings file that it reads from the current folder.

Numba reads ``.numba_config.yaml`` when it is imported and before each compilation. The current folder may be that of
another person's data, whose file could switch the compiler off or end every command with a traceback. The variables
``NUMBA_...`` of the environment are the user's choice and remain in effect.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType, ModuleType

_MODULE, _FILE = "numba.core.config", ".numba_config.yaml"


class _Loader(SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType | None:
        """Return the code of the module with an empty file name, which exists nowhere."""
        code = super().get_code(fullname)
        return code and code.replace(co_consts=tuple("" if each == _FILE else each for each in code.co_consts))


class _Finder:
    @staticmethod
    def find_spec(
        fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find Numba's settings (implements `importlib.abc.MetaPathFinder`)."""
        spec = PathFinder.find_spec(fullname, path, target) if fullname == _MODULE else None
        if spec and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


def ignore_current_folder() -> None:
    """Read no settings file in this process; call it before Numba is imported."""
    sys.meta_path.insert(0, _Finder)
