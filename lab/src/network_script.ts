/** A script of its own, which the page loads when something is asked for the first time. */

import source from "worker:network_worker.ts";

(window as { inflateNetwork?: string }).inflateNetwork = source;
