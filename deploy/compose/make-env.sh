#!/bin/sh
# Writes .env beside this file, readable by its owner only: .env.example with a random secret for every empty value.
# An existing .env is not changed, because volumes keep the passwords they were made with.
set -eu
cd "$(dirname "$0")"
umask 077
if [ -e .env ]; then
    echo "$PWD/.env is there already; it stays as it is" >&2
    exit 1
fi
while IFS= read -r line; do
    case $line in
        *=) printf '%s%s\n' "$line" "$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')" ;;
        *) printf '%s\n' "$line" ;;
    esac
done < .env.example > .env.new
mv .env.new .env
echo "wrote $PWD/.env"
