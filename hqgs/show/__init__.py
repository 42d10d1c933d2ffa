"""What people look at: pictures, films, the report as a page, a live page, scene files for other viewers."""
