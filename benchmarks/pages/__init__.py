"""The pages of results, written whole from the tables: templates, and what they compute."""
