"""KTX2: what another decoder (Basis Universal as WebAssembly, of three.js) shows, and damaged files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsbake.imaging.ktx2 import decode_ktx2, encode_ktx2, ktx2_size
from tests.support.node import run_node

DECODE = """
const folder = process.argv[1] + '/three/examples/jsm/libs/basis', fs = require('fs');
const source = fs.readFileSync(folder + '/basis_transcoder.js') + '; return BASIS;';
const load = new Function('module', 'exports', '__dirname', 'require', source);
load({exports: {}}, {}, folder, require)({wasmBinary: fs.readFileSync(folder + '/basis_transcoder.wasm')}).then(basis => {
  basis.initializeBasis();
  const file = new basis.KTX2File(new Uint8Array(fs.readFileSync(process.argv[2])));
  if (!file.isValid() || !file.startTranscoding()) throw new Error('invalid');
  const pixels = new Uint8Array(file.getImageTranscodedSizeInBytes(0, 0, 0, 13));
  if (!file.transcodeImage(pixels, 0, 0, 0, 13, 0, -1, -1)) throw new Error('not transcoded');
  fs.writeFileSync(process.argv[3], pixels);
  console.log(JSON.stringify({width: file.getWidth(), height: file.getHeight(), levels: file.getLevels(), uastc: file.isUASTC()}));
});
"""


def photograph(size: int = 64) -> np.ndarray:
    """A smooth picture with edges."""
    rng = np.random.default_rng(0)
    small = rng.integers(100, 160, (8, 8, 3), dtype=np.uint8)
    image = cv2.resize(small, (size, size), interpolation=cv2.INTER_CUBIC)
    image[size // 3 : size // 2, size // 4 : size // 2] = (200, 60, 40)
    return image


@pytest.mark.parametrize(("codec", "least"), [("uastc", 38.0), ("etc1s", 27.0)])
def test_another_decoder_shows_the_same_picture(tmp_path: Path, codec: str, least: float) -> None:
    image = photograph()
    content = encode_ktx2(image, "uastc" if codec == "uastc" else "etc1s", 100, srgb=True)
    (tmp_path / "a.ktx2").write_bytes(content)
    found = run_node(DECODE, "three", tmp_path / "a.ktx2", tmp_path / "a.rgba")
    assert (found["width"], found["height"], found["levels"]) == (64, 64, 7) and bool(found["uastc"]) == (codec == "uastc")
    theirs = np.frombuffer((tmp_path / "a.rgba").read_bytes(), np.uint8).reshape(64, 64, 4)
    assert np.abs(theirs.astype(int) - decode_ktx2(content)).max() <= 1
    error = np.mean((theirs[..., :3].astype(float) - image) ** 2)
    assert 10 * np.log10(255**2 / error) > least
    assert ktx2_size(content) == (64, 64)


def test_the_bytes_depend_on_the_pixels_only() -> None:
    assert encode_ktx2(photograph(), "uastc", 100, srgb=False) == encode_ktx2(photograph(), "uastc", 100, srgb=False)


def test_a_grey_image_has_three_equal_channels() -> None:
    grey = photograph()[..., 0]
    pixels = decode_ktx2(encode_ktx2(grey, "uastc", 100, srgb=False)).astype(int)
    assert np.abs(pixels[..., 0] - pixels[..., 1]).max() <= 2 and np.abs(pixels[..., 0] - grey).mean() < 3


def test_damaged_files_are_refused() -> None:
    content = encode_ktx2(photograph(), "uastc", 100, srgb=True)
    large = bytearray(content)
    large[20:24] = (1 << 30).to_bytes(4, "little")
    for wrong in (b"", content[:40], content[:200], content[: len(content) // 2], bytes(large), b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(100)):
        with pytest.raises(ValueError, match=r"KTX2|states|damaged|size"):
            decode_ktx2(wrong)
    assert json.dumps(ktx2_size(content)) == "[64, 64]"
