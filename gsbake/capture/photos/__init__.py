"""Single photos: decoding, EXIF, quality, redundancy, exposure, lens distortion."""
