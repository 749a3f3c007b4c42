PAGE_DATA=None
def write_page(r): pass
