"""What every room stands on: files, threads, machine, text, records. It imports nothing of hqgs."""
