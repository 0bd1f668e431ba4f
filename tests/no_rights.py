"""A program that may read everything and write only where its user may: what permissions mean to all but root."""

import os
import shutil

import pytest


def without_root_rights():
    """Words before a command line; the test is skipped where root cannot give its rights away."""
    if os.geteuid():
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("root may write everywhere, and there is no setpriv")
    return ["setpriv", "--bounding-set=-dac_override,-dac_read_search,-fowner", "--inh-caps=-all"]
