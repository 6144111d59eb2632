"""Front end: a balance of forces, known by driving force and motion alone."""
