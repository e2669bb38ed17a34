"""Single photos: decoding, EXIF, quality, redundancy, undistortion."""
