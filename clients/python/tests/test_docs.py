"""The programs that the documentation shows, run as they are but for address and names."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest
from conftest import ROOT, SOON, Server
from test_node import pki  # noqa: F401, a fixture

import ecod


def programs() -> Iterator[tuple[str, str]]:
    for page in ("clients/python/README.md", "docs/programs.md", "README.md"):
        blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)
        yield from ((f"{page}-{number}", block) for number, block in enumerate(blocks, 1))


PROGRAMS = dict(programs())


def test_the_documentation_shows_programs() -> None:
    assert len(PROGRAMS) >= 4, PROGRAMS.keys()


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_documented_program_does_what_it_says(
    edge: Callable[..., Server],
    cell_name: str,
    pki: Callable[..., dict[str, str]],  # noqa: F811
    name: str,
) -> None:
    text, settings = PROGRAMS[name].replace('"lot-1"', f'"{cell_name}"'), {}
    if "/etc/ecod/node.pem" in text:
        own, program = pki("edge", "edge"), pki("euclid", "cav")
        settings = {"ECOD_TLS__CA": own["ca"], "ECOD_TLS__CERTIFICATE": own["cert"], "ECOD_TLS__KEY": own["key"]}
        for file, path in (("ca.pem", program["ca"]), ("node.pem", program["cert"]), ("node.key", program["key"])):
            text = text.replace(f"/etc/ecod/{file}", path)
        text += "cell.close()\n"
    node = edge(ECOD_FUSION__TRACKS__MODE="on", **settings)
    text = re.sub("localhost:[18]883", node.address, text)
    is_endless = "while True" in text or "for map in" in text
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", f"import ecod\n{text}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "ECOD_BROKER": node.address, "ECOD_CELL": cell_name, "ECOD_NAME": "edge"},
    )
    try:
        if is_endless and "cell.report" in text:
            with ecod.Cell(node.address, cell_name) as cell:
                began = time.monotonic()
                for map in cell.maps(timeout=SOON):
                    if any("euclid" in thing.contributors for thing in map.objects):
                        break
                    assert process.poll() is None, process.communicate()
                    assert time.monotonic() - began < SOON, "its report is not on the map"
        elif is_endless:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert re.match(r"\d+ \[", line), (line, process.poll() is not None and process.communicate())
        else:
            said = process.communicate(timeout=SOON)
            assert process.returncode == 0, said
    finally:
        process.kill()
        process.communicate()
