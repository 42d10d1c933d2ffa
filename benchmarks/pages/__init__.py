"""The pages of results, written whole from the tables: templates, what they compute, charts."""
