"""The report of a diagnosis for a person."""
def write_report(case, found, path):
    """Placeholder until the page is written below in this session."""
    path.write_text("<html></html>")
