"""Pose graphs by name, from the data folders or by a download that is checked.

The data folders are the project's, ./data, and the folder that PGO_DATA names.
"""

import difflib
import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from pgo_models.errors import DatasetError, FileFormatError, SettingError
from pgo_models.files import replace_when_done
from pgo_models.graphs.g2o import COMPRESSED, edge_places, name_of, read_g2o
from pgo_models.graphs.g2o_readings import Reading
from pgo_models.graphs.jrl import SUFFIX, jrl_edge_places, read_jrl
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.trajectories import read_tum

DATA_VARIABLE = "PGO_DATA"
_TIMEOUT = 30.0  # seconds without an answer
# Folder of SE-Sync's g2o files: that of a name is at `SE_SYNC_URL/name.g2o`.
SE_SYNC_URL = "https://raw.githubusercontent.com/david-m-rosen/SE-Sync/master/data"
# Name of a data set to `sha256:` and the digest of its file, or to `blob:` and its git blob id,
# which is the SHA-1 of "blob <size>", a zero byte, and the file.
CHECKSUMS: Mapping[str, str] = {
    "CSAIL": "sha256:66d99ac857a9849d814d214a9ebd0d4876d5d40f0a37be9330c1ff6e6e9daaa6",
    "city10000": "sha256:df5988994339e990be198a36e7f640e31a5a1b26df3ed400363fafc49d5ca630",
    "cubicle": "sha256:f7781d485383cec86d47d7650970132c36d6f3a1f4e5d62a49b7f8245c0a6465",
    "grid3D": "blob:0dee46a9e43e1f51b9d4466ac6119e5bb6966954",
    "intel": "sha256:3e0724c048e0ba524be9dd268a8b78e19a2497043143584cbb61310638b15c4b",
    "kitti_00": "sha256:8a9807f604852a44254910100917918def94d7357748c633e1fd7ce73dd17468",
    "manhattan": "sha256:6ae8d30971720c1af24a00c4b2dd5c5ddafbbbe488bfc771145c47decbffb248",
    "parking-garage": "sha256:3ac0a31bfb601d7455d451e2546655cb5dececf51a7823f57c8a7e0fe1ca6527",
    "rim": "blob:0c2f783b9d71012a612f09673f5aed87ae65f954",
    "smallGrid3D": "sha256:9ea56c2ad1ebcc322560eb2f8d83cb3a60f99e2e2acc35e097b1162cdbafd649",
    "sphere2500": "sha256:104ab57593394f24351d9f692f3b923f8b98fff1eb638c64356cf5049e06cf3c",
    "tinyGrid3D": "sha256:c341eb0d09f7556b337be5a62b9354384885333a25fa718fd699fafb19620493",
    "torus3D": "sha256:1ef8831023b372188d33ca63ce0da079d51df89364df71f2bce1c5c7c69ed5ec",
}


def load(
    name_or_path: str | Path,
    *,
    download: bool = True,
    reading: Reading = Reading.AS_WRITTEN,
    unit_weights: bool = False,
    skip_unknown: bool = False,
    trust_folder: bool = False,
) -> PoseGraph:
    """Load a pose graph by the name of a data set, or from a file or folder.

    A name is looked for in the project's data folder, in ./data, in the folder that the environment
    variable PGO_DATA names, and in the user's cache; then it is downloaded. What the cache holds is
    checked against its checksum. Beside `x.g2o`, or the folder `x`, a file `x.truth.tum` gives the
    ground truth, in the order of the poses.

    Parameters
    ----------
    name_or_path : str or Path
        Name of a data set (`known_datasets`), a g2o file, a folder with one for each robot, or a
        file of a JSON robot log, whose name ends in .jrl (`read_jrl`).
    download : bool
        Whether a data set that is not there is downloaded.
    reading : Reading
        As for `read_g2o`; a JSON robot log leaves no choice.
    unit_weights, skip_unknown, trust_folder : bool
        As for `read_g2o`.

    Raises
    ------
    DatasetError
        When the name is unknown, the download fails or is not wanted, or its checksum is wrong.
    SettingError
        When a JSON robot log is to be read in another way than it is written.
    FileFormatError
        As for `read_g2o`; also when the truth has not one pose for each of the graph.

    References
    ----------
    Rosen, Carlone, Bandeira & Leonard, SE-Sync: a certifiably correct algorithm for synchronization
    over the special Euclidean group, IJRR 2019.

    Examples
    --------
    >>> load("sphere")
    PoseGraph('sphere', d=3, poses=50, edges=544, robots=1)
    """
    path = locate(name_or_path, download=download)
    reading = Reading.of(reading)
    if path.suffix != SUFFIX:
        graph = read_g2o(
            path,
            reading=reading,
            unit_weights=unit_weights,
            skip_unknown=skip_unknown,
            trust_folder=trust_folder,
        )
    elif reading is not Reading.AS_WRITTEN:
        raise SettingError(f"{path} says what it has, covariances; leave {reading.value} out")
    else:
        graph = read_jrl(path, skip_unknown=skip_unknown)
        graph = graph.unit_weights() if unit_weights else graph
    truth_path = path.absolute().parent / f"{name_of(path)}.truth.tum"
    if not os.path.isfile(truth_path):
        return graph
    truth = read_tum(truth_path, d=graph.d)
    if truth.num_poses != len(graph.in_files):
        problem = (
            f"{truth.num_poses} poses, but {path} has {len(graph.in_files)}; remove or redo it"
        )
        raise FileFormatError(truth_path, None, problem)
    return replace(graph, truth=truth)


def locate(name_or_path: str | Path, *, download: bool = True) -> Path:
    """File or folder that `load` reads; parameters and errors as there."""
    path = Path(name_or_path)
    name = str(name_or_path)
    if not name:
        raise DatasetError(
            "the name of the graph is empty; give a g2o file, a folder or a data set's name"
        )
    # os.path, for which a name too long for the system is no file, and no error. A pipe or a device
    # is read like a file.
    if os.path.isdir(path):
        if _holds_g2o(path) or name not in known_datasets():
            return path
    elif os.path.exists(path):
        return path
    if name == path.name and path.suffix == ".g2o" and path.stem in known_datasets():
        name = path.stem  # the file that a data set is kept in
    is_file_name = name.endswith((".g2o", SUFFIX, COMPRESSED))
    if isinstance(name_or_path, Path) or is_file_name or name != Path(name).name:
        raise FileFormatError(
            path, None, "no such file or folder; check the path, or give a data set's name"
        )
    in_folder = _in_folders(name)
    if in_folder is not None:
        return in_folder
    if name not in CHECKSUMS:
        raise _unknown(name)
    return _cached(name, download)


def places_of_edges(path: Path) -> list[str]:
    """`file:line` of every edge of the graph in a file or folder; as `load` reads it."""
    return jrl_edge_places(path) if path.suffix == SUFFIX else edge_places(path)


def _in_folders(name: str) -> Path | None:
    """File or folder of a data set in the data folders."""
    for folder in _folders():
        for candidate in (folder / f"{name}.g2o", folder / name):
            if os.path.isfile(candidate) or (os.path.isdir(candidate) and _holds_g2o(candidate)):
                return candidate
    return None


def _unknown(name: str) -> DatasetError:
    """Error of a name that is no data set, with those that are spelled alike."""
    known = known_datasets()
    similar = difflib.get_close_matches(name, known, n=3)
    suggestion = f"did you mean {' or '.join(similar)}? " if similar else ""
    return DatasetError(
        f"no file and no data set {name!r}; {suggestion}known are {', '.join(known)}; "
        f"or give a path, or put {name}.g2o into the folder named by {DATA_VARIABLE}"
    )


def known_datasets() -> tuple[str, ...]:
    """Return the names that `load` takes, in alphabetical order.

    They are those of the files in the data folders, and of those that can be downloaded.
    """
    names = set(CHECKSUMS)
    for folder in _folders():
        files = [file for file in folder.glob("*.g2o") if file.is_file()]
        folders = [entry for entry in folder.iterdir() if entry.is_dir() and _holds_g2o(entry)]
        names.update(file.stem for file in files)
        names.update(entry.name for entry in folders)
    return tuple(sorted(names, key=lambda name: (name.lower(), name)))


def project_folders() -> list[Path]:
    """Where the project's own data can be.

    It is inside an installed package, and beside the packages in a checkout.
    """
    package = Path(__file__).resolve().parents[1]
    return [package / "data", package.parent / "data"]


def _folders() -> list[Path]:
    """Data folders that exist, in the order in which they are searched."""
    folders = [*project_folders(), Path("data")]
    if os.environ.get(DATA_VARIABLE):
        folders.append(Path(os.environ[DATA_VARIABLE]))
    return [folder for folder in folders if folder.is_dir()]


def _holds_g2o(folder: Path) -> bool:
    return any(folder.glob("*.g2o"))


def _cached(name: str, download: bool) -> Path:
    """File of a data set in the cache, downloaded if it is not there."""
    import pooch  # here, since it and requests take longer to import than all the rest

    cache = Path(pooch.os_cache("pgo-splitting"))
    path = cache / f"{name}.g2o"
    checksum = CHECKSUMS[name]
    if path.is_file() and _fits(path, checksum):
        return path
    if not download:
        raise DatasetError(
            f"{name} is not here; download it with: pgo info {name}, or {_by_hand(name)}"
        )
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DatasetError(
            f"cannot make the cache folder {cache}: {error.strerror}; {_by_hand(name)}"
        ) from error
    url = f"{SE_SYNC_URL}/{name}.g2o"
    with replace_when_done(path) as temporary:
        _download(url, temporary, name)
        if not _fits(temporary, checksum):
            raise DatasetError(
                f"{url} does not have the checksum {checksum}; try again, or {_by_hand(name)}"
            )
    return path


def _download(url: str, path: Path, name: str) -> None:
    """Download a file."""
    import requests

    try:
        with (
            requests.get(url, stream=True, timeout=_TIMEOUT) as response,
            path.open("wb") as file,
        ):
            response.raise_for_status()
            for chunk in response.iter_content(2**16):
                file.write(chunk)
    except requests.RequestException as error:
        if error.response is not None:
            reason = f"status {error.response.status_code}"
        elif isinstance(error, requests.Timeout):
            reason = "no answer in time"
        else:
            reason = "no connection"
        raise DatasetError(
            f"{name} is not here, and {url} cannot be had ({reason}); {_by_hand(name)}"
        ) from error


def _by_hand(name: str) -> str:
    """Way out where a download is not possible."""
    return (
        f"get {name}.g2o in another way and put it into ./data "
        f"or the folder named by {DATA_VARIABLE}"
    )


def _fits(path: Path, checksum: str) -> bool:
    """Whether a file has a checksum."""
    kind, _, expected = checksum.partition(":")
    data = path.read_bytes()
    if kind == "blob":
        blob = b"blob %d\0" % len(data) + data
        digest = hashlib.sha1(blob, usedforsecurity=False).hexdigest()
    else:
        digest = hashlib.sha256(data).hexdigest()
    return digest == expected
