"""The check of what a release has built: packages, the description for the index, and the site."""

from __future__ import annotations

import email.policy
import io
import json
import re
import tarfile
import zipfile
from collections.abc import Iterator
from email.message import EmailMessage
from email.parser import BytesParser
from pathlib import Path

_TARGET = re.compile(r"\]\((?P<target>[^)\s]+)\)")
NPM_FILES = {"fibaction.js", "fibaction.d.ts", "package.json", "README.md"}
"""What the package for JavaScript must have; it may have more types."""
NPM_FOLDER = Path("build/release")


def faults(root: Path, version: str) -> list[str]:
    """Return what is wrong with the packages and the site of a version, a sentence for each."""
    names = {path.name for path in (root / "dist").iterdir()}
    wheel = f"fibaction-{version}-py3-none-any.whl"
    expected = {wheel, f"fibaction-{version}.tar.gz"}
    if names != expected:
        return [f"dist/ has {sorted(names)}, and has to have {sorted(expected)}"]
    return [
        *_of_description((root / "dist" / wheel).read_bytes(), version),
        *_of_npm(root / NPM_FOLDER / f"fibaction-{version}.tgz", version),
        *_of_site(root / "site" / "index.html", version),
    ]


def description_of(wheel: bytes) -> EmailMessage:
    """Return the metadata of a wheel, whose content is the description."""
    with zipfile.ZipFile(io.BytesIO(wheel)) as archive:
        (name,) = (each for each in archive.namelist() if each.endswith(".dist-info/METADATA"))
        raw = archive.read(name)
    return BytesParser(policy=email.policy.default.clone(utf8=True)).parsebytes(raw)


def _of_description(wheel: bytes, version: str) -> Iterator[str]:
    metadata = description_of(wheel)
    if metadata["Version"] != version:
        yield f"the wheel says that it is {metadata['Version']}"
    text = metadata.get_content()
    for target in _TARGET.findall(text):
        if "://" not in target and not target.startswith("#"):
            yield f"the description has the relative link {target}"
    if "not published" in text:
        yield "the description says that fibaction is not published"
    if "pip install 'fibaction[cli]'" not in text:
        yield "the description does not say how to install fibaction"


def _of_npm(package: Path, version: str) -> Iterator[str]:
    if not package.is_file():
        yield f"{package.name} is missing: npm packs it"
        return
    with tarfile.open(package) as archive:
        names = {member.name.removeprefix("package/") for member in archive}
        file = archive.extractfile("package/package.json")
        assert file is not None
        told = json.load(file)
    if missing := NPM_FILES - names:
        yield f"{package.name} lacks {sorted(missing)}"
    if told["version"] != version:
        yield f"{package.name} says that it is {told['version']}"


def _of_site(index: Path, version: str) -> Iterator[str]:
    header = index.read_text(encoding="utf-8").partition("<header")[2].partition("</header>")[0]
    if f">{version}<" not in header:
        yield f"the header of the site has not the version {version}"
    if 'class="md-source"' not in header:
        yield "the header of the site has no link to the repository"
