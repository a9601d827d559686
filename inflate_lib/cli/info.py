"""``inflate info``: versions and folders."""

import os
import platform

from inflate_lib.cli.app import app


@app.command()
def info() -> None:
    """Print versions, folders and the device that training would use."""
    from inflate_lib import paths
    from inflate_lib._provenance import package_versions

    print(f"Python {platform.python_version()} on {platform.platform()}")
    for name, version in package_versions().items():
        print(f"{name} {version}")
    print(f"{'checkout' if paths.in_checkout() else 'no checkout; installed in'} {paths.ROOT}\ncache {paths.CACHE}")
    print(f"MNIST {os.environ.get('INFLATE_MNIST_DIR', 'by download')}")
