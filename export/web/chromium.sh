#!/bin/sh
# Prints where Chromium is; root on Debian gets it installed.
for name in "${CHROMIUM:-chromium}" chromium chromium-browser google-chrome; do
    command -v "$name" && exit
done
if [ "$(id -u)" = 0 ] && command -v apt-get > /dev/null; then
    { apt-get update && apt-get install -y --no-install-recommends chromium; } >&2 && command -v chromium && exit
fi
echo "Chromium is needed: install it (Debian: apt-get install chromium) or give its path: CHROMIUM=/path/to/chromium" >&2
exit 1
