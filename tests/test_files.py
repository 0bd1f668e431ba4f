import os

import pytest

from avp_habitat.errors import SceneError, UsageError
from avp_habitat.files import atomic_file, atomic_folder, check_new, check_writable


def test_a_file_appears_when_it_is_whole_and_replaces_the_old_one(tmp_path):
    path = tmp_path / "new" / "a.npz"
    for content in ("first", "second"):
        with atomic_file(path) as partial:
            assert (partial.parent, partial.suffix, partial.name[0]) == (path.parent, ".npz", ".")
            partial.write_text(content, encoding="ascii")
            assert not path.exists() or path.read_text(encoding="ascii") == "first"
        assert path.read_text(encoding="ascii") == content
    assert list(path.parent.iterdir()) == [path]
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


def test_a_folder_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "new" / "r"
    with atomic_folder(path) as partial:
        (partial / "a").touch()
        assert not path.exists()
    assert [file.name for file in path.iterdir()] == ["a"]
    assert list(path.parent.iterdir()) == [path]


def fail(context, error):
    with context as partial:
        (partial / "a" if partial.is_dir() else partial).touch()
        raise error


@pytest.mark.parametrize("atomic", [atomic_file, atomic_folder])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_error_leaves_nothing(tmp_path, atomic, error):
    expected = SceneError if isinstance(error, OSError) else error
    with pytest.raises(expected) as raised:
        fail(atomic(tmp_path / "r", failure=SceneError, option="--out"), error)
    if expected is SceneError:
        assert str(raised.value) == f"--out {tmp_path / 'r'}: cannot write there: No space left on device"
        with pytest.raises(OSError, match="No space"):
            fail(atomic(tmp_path / "r"), error)
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_refused_at_the_start_and_at_the_end(tmp_path):
    path = tmp_path / "r"
    with pytest.raises(UsageError, match="r: exists already"), atomic_file(path, replace=False) as partial:
        (path.write_text("theirs", encoding="ascii"), partial.touch())
    with pytest.raises(UsageError, match="r: exists already"), atomic_file(path, replace=False):
        raise AssertionError("refused before")
    assert path.read_text(encoding="ascii") == "theirs"
    path.unlink()
    with pytest.raises(UsageError, match="another program made it"), atomic_folder(path):
        path.mkdir()
    path.rmdir()
    path.symlink_to("nowhere")
    with pytest.raises(UsageError, match=r"--out .*exists already"):
        check_new(path, option="--out")
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_a_file_is_not_writable(tmp_path):
    (tmp_path / "file").touch()
    for atomic in (atomic_file, atomic_folder):
        with pytest.raises(SceneError, match="cannot write there"), atomic(tmp_path / "file" / "r", failure=SceneError):
            raise AssertionError("refused before")
    with pytest.raises(SceneError, match=r"--out .*cannot write there: .*file"):
        check_writable(tmp_path / "file" / "r", failure=SceneError)
    check_writable(tmp_path / "more" / "r")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
