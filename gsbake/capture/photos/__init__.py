"""Single photos: decoding, EXIF, quality, redundancy, exposure, undistortion."""
