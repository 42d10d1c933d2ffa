"""How files of photos end; apart from their reading, for which those who only look for them need not wait."""

HEIC_SUFFIXES = (".heic", ".heif")  # what iPhones write; an extra reads them
JPEG_SUFFIXES = (".jpg", ".jpeg", ".jfif", ".jpe")
PHOTO_SUFFIXES = (".png", *JPEG_SUFFIXES, ".tif", ".tiff", ".bmp", ".webp", ".avif", ".jp2", *HEIC_SUFFIXES)
RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".x3f")
